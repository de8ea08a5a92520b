# SPDX-License-Identifier: Apache-2.0
"""Ends that something hides in all keyframes: the pipe is as long as it is expected to be, no shorter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.axial_evidence import FARTHEST, axial_evidence
from pipeprog_detect.refinement.extension import LEAST, MAX_EXTENSIONS
from pipeprog_detect.silhouette.apparent_contour import in_image, views_showing
from pipeprog_detect.silhouette.free_space import MIN_VIEWS, free_stretches
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.planes_met import distance_to
from pipeprog_detect.verification.scene_context import SceneContext

# Distance [m] between the positions of the end that are weighed: the step of a free stretch.
STEP = 0.01
# Views that tell the evidence of the contour: of more than thirty each adds less than a hundredth, since errors that
# views share (COMMON) remain.
ENOUGH_VIEWS = 30


def with_open_ends(
    measured: Sequence[MeasuredPipe], context: SceneContext, views: Sequence[View]
) -> list[MeasuredPipe]:
    """The pipes with each end that the views leave open where it is expected.

    Growth adds what is certain, and stops where something hides the pipe. Its end then lies farther, never nearer: the
    lengths of all pipes that something hides would be too short.
    """
    if not views:
        return list(measured)
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> MeasuredPipe:
        others = cylinders[:number] + cylinders[number + 1 :]
        each = measured[number]
        start, end = (_further(each, at_end, context, views, others) for at_end in (False, True))
        longer = each.cylinder.lengthened(False, start).lengthened(True, end)
        rims = (0.0 if start else each.rims[0], 0.0 if end else each.rims[1])
        return replace(each, cylinder=longer, rims=rims)

    return mapped(one, range(len(measured)))


def _further(
    measured: MeasuredPipe, at_end: bool, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> float:
    """How far [m] beyond a given end the pipe is expected to end; 0 where that is less than the ends are known to."""
    cylinder, rim, further = measured.cylinder, measured.rims[at_end], 0.0
    for _ in range(MAX_EXTENSIONS):
        longer = cylinder.lengthened(at_end, further)
        ahead = _clear(longer, at_end, context, views, others)
        expected = _expected(longer, at_end, ahead, rim, views, others)
        if expected < np.inf:
            further += expected
            break
        further, rim = further + ahead, 0.0
    return further if further > LEAST else 0.0


def _expected(
    cylinder: Cylinder, at_end: bool, ahead: float, rim: float, views: Sequence[View], others: Sequence[Cylinder]
) -> float:
    """How far [m] beyond a given end the pipe is expected to end: infinite, if farther than is looked.

    Prior: ends occur as a Poisson process with one end per measured length. The evidence of the contour is added;
    where something hides the pipe there is none. `rim`: evidence for an end rim at the given end.
    """
    if ahead < LEAST:
        return 0.0
    looking = views_showing(_beyond(cylinder, at_end, np.linspace(0.0, ahead, 9)), views, ENOUGH_VIEWS)
    evidence = axial_evidence(Scene.of(cylinder, looking, others), at_end, ahead)
    if evidence is None:
        return 0.0
    along, total = evidence.beyond()
    place = np.arange(0.0, ahead, STEP)
    odds = total[np.searchsorted(along[1:], place)] - place / cylinder.length
    odds[0] += rim
    probability = np.exp(odds - odds.max())
    # Farther than is looked the prior alone is left: its integral is one measured length.
    is_farther = ahead == _looked_ahead(cylinder) and probability[-1] * cylinder.length > probability.sum() * STEP
    return np.inf if is_farther else float(probability @ place / probability.sum())


def _looked_ahead(cylinder: Cylinder) -> float:
    return min(cylinder.length, FARTHEST)


def _beyond(cylinder: Cylinder, at_end: bool, distance: NDArray[np.floating[Any]]) -> FloatArray:
    """Points (N, 3) on the axis at a `distance` (N,) [m] beyond an end."""
    end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
    return np.asarray(end + distance[:, None] * out, np.float64)


def _clear(
    cylinder: Cylinder, at_end: bool, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> float:
    """How far [m] beyond an end the pipe may go on at the most, within the images.

    No farther than a plane, another pipe, a stretch through which the views see, or the edge of the images.
    """
    end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
    ahead = _looked_ahead(cylinder)
    for plane in context.planes:
        distance = distance_to(plane, end, out)
        ahead = min(ahead, distance) if distance is not None and distance > 0.0 else ahead
    place = np.arange(STEP, ahead, STEP)
    points = _beyond(cylinder, at_end, place)
    shown = np.sum([in_image(view, points) for view in views], axis=0)
    ended = shown < MIN_VIEWS
    for other in others:
        along = other.along(points)
        within = np.linalg.norm(other.from_axis(points), axis=1) < other.radius
        ended |= within & (along > 0.0) & (along < other.length)
    if ended.any():
        ahead = float(place[int(np.argmax(ended))])
    if ahead < LEAST:
        return 0.0
    free = free_stretches(Cylinder(end, end + ahead * out, cylinder.radius), views, others, known=cylinder)
    return min([ahead, *(first for first, _ in free)])
