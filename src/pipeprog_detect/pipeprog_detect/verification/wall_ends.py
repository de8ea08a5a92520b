# SPDX-License-Identifier: Apache-2.0
"""Ends at walls, floors and ceilings: those that no keyframe shows, and those that lie behind the wall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.refinement.axial_evidence import axial_evidence
from pipeprog_detect.silhouette.apparent_contour import views_showing
from pipeprog_detect.silhouette.free_space import free_stretches
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.planes_met import (
    LEAST_POINTS,
    SAME_PLANE,
    distance_to,
    is_end_of,
    points_on,
    surrounds,
)
from pipeprog_detect.verification.scene_context import SceneContext

# Views that suffice to tell whether the pipe goes on.
ENOUGH_VIEWS = 12


def with_ends_on_walls(
    cylinder: Cylinder,
    rims: tuple[float, float],
    context: SceneContext,
    views: Sequence[View],
    others: Sequence[Cylinder],
) -> Cylinder:
    """The cylinder with its ends on the planes of the `context` that it runs into.

    Prior: ends occur along a pipe as a Poisson process with one end per measured length. Where the keyframes do not
    show that the pipe stops before a plane, it is the more probable that it goes on to the plane the nearer that is.
    Where they see through what is between, the edges there are of something else in line with the pipe.
    Where no keyframe looks the floor, the ceiling and the walls of the room go on; other planes end.
    A part that lies behind a plane as seen from every camera, and that the plane surrounds, was not seen: it is cut.

    Args:
        cylinder: the measured pipe.
        rims: evidence for an end rim at its start and at its end (`pipe_ends.End.odds`).
        context: the planes and their points.
        views: the keyframes.
        others: further pipes, which may hide this one.
    """
    ends = []
    for at_end in (False, True):
        end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
        nearest = min(planes_ahead(cylinder, at_end, context, views, others), default=0.0)
        if nearest > 0.0 and (
            not _goes_on(cylinder, at_end, rims[at_end], nearest, views, others)
            or free_stretches(Cylinder(end, end + nearest * out, cylinder.radius), views, others, cylinder)
        ):
            nearest = 0.0
        ends.append(end + nearest * out)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def planes_ahead(
    cylinder: Cylinder, at_end: bool, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> list[float]:
    """How far [m] beyond an end, or before it, the axis meets the planes of the `context` that it may end at.

    The ends of `others` are none of them.
    """
    end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
    ahead: list[float] = []
    for plane in sorted(context.planes, key=lambda plane: -plane.area):
        if any(is_end_of(plane, other) for other in others):
            continue
        distance = _distance(end, out, cylinder, plane, context, views)
        # Small planes are pieces of large ones, whose position they tell less precisely.
        if distance is not None and all(abs(distance - other) > SAME_PLANE for other in ahead):
            ahead.append(distance)
    return ahead


def _distance(
    end: FloatArray, out: FloatArray, cylinder: Cylinder, plane: Plane, context: SceneContext, views: Sequence[View]
) -> float | None:
    """How far [m] beyond the end, or before it, the axis meets the plane; None where that says nothing of the end."""
    distance = distance_to(plane, end, out)
    # Half of the ends lie within ln 2 of the mean distance between them; of what a plane hides a radius is left.
    if distance is None or not cylinder.radius - cylinder.length < distance < np.log(2.0) * cylinder.length:
        return None
    place = end + distance * out
    offset = points_on(plane.normal, place, context)
    if len(offset) < LEAST_POINTS:
        is_unseen = bool(views) and not views_showing(place[None], views, 1)
        return distance if distance > 0.0 and is_unseen and context.bounds_room(plane, out) else None
    if distance < 0.0:
        before = float(plane.normal @ out)
        seen_from = [before * float(plane.offset - plane.normal @ view.centre) for view in views]
        if min(seen_from, default=0.0) <= 0.0 or not surrounds(offset, out, cylinder.radius):
            return None
    return distance


def _goes_on(
    cylinder: Cylinder, at_end: bool, rim: float, ahead: float, views: Sequence[View], others: Sequence[Cylinder]
) -> bool:
    """Whether it is more probable that the pipe goes on for `ahead` [m] than that it ends within that."""
    end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
    looking = views_showing(end + np.linspace(0.0, 1.0, 5)[:, None] * ahead * out, views, ENOUGH_VIEWS)
    total: FloatArray = np.zeros(1)
    place: FloatArray = np.zeros(1)
    if looking:
        evidence = axial_evidence(Scene.of(cylinder, looking, others), at_end, ahead)
        if evidence is None:
            return False
        beyond = (evidence.along > 0.0) & (evidence.along < ahead)
        total = np.append(0.0, np.cumsum(evidence.log_odds[beyond]))
        place = np.append(0.0, evidence.along[beyond])
    rate = 1.0 / cylinder.length
    # Before anything is seen an end is as probable as its stretch is long: the last stretch goes on to the plane.
    parts = np.concatenate([[0.0], 0.5 * (place[1:] + place[:-1]), [ahead]])
    ends_here = total - rate * parts[:-1] + np.log(-np.expm1(-rate * np.diff(parts)))
    ends_here[0] += rim
    return bool(total[-1] - rate * ahead > np.logaddexp.reduce(ends_here))
