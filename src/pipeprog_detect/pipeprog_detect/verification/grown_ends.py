# SPDX-License-Identifier: Apache-2.0
"""Ends that a pipe has grown to: cut back where, now that all pipes are known, its contour does not reach there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_detect.refinement.axial_evidence import axial_evidence
from pipeprog_detect.refinement.extension import CERTAIN, LEAST
from pipeprog_detect.refinement.pipe_ends import find_end
from pipeprog_detect.silhouette.free_space import free_stretches
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe

# Stretches longer than this [m] that the views see through are none of a pipe. Beside what hides a barrel, and at its
# ends, stereo loses a window on either side, 40 px in all: 0.17 m at 4 m with 720p (0.06 to 0.11 m measured at 2 m).
SEEN_THROUGH = 0.2


def with_grown_ends(measured: Sequence[MeasuredPipe], views: Sequence[View]) -> list[MeasuredPipe]:
    """The pipes without what they have grown by where that is certainly none of theirs.

    A pipe grows piece by piece, each time as far as its last piece tells: a line of the background in line with a side
    leads it on. All that the contour shows beyond the cloud's cylinder tells together where it ends. Where the views
    see through much of it, the edges there are of something else in line with the pipe.
    """
    if not views:
        return list(measured)
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> MeasuredPipe:
        others = cylinders[:number] + cylinders[number + 1 :]
        return _cut(_cut(measured[number], False, views, others), True, views, others)

    return [one(number) for number in range(len(measured))]


def _cut(measured: MeasuredPipe, at_end: bool, views: Sequence[View], others: Sequence[Cylinder]) -> MeasuredPipe:
    """The pipe up to where the evidence beyond the cloud's cylinder is greatest, if it is certainly less at its end."""
    whole, found = measured.cylinder, measured.candidate.cylinder
    low, high = np.clip(np.sort(whole.along(np.stack([found.start, found.end]))), 0.0, whole.length).tolist()
    grown = whole.length - high if at_end else low
    if grown < LEAST or high - low < LEAST:
        return measured
    known = whole.cut(low, high)
    through = _free_from(known, whole, at_end, views, others)
    if through < grown:
        whole, grown = whole.lengthened(at_end, through - grown), through
        measured = replace(
            measured, cylinder=whole, rims=(measured.rims[0], 0.0) if at_end else (0.0, measured.rims[1])
        )
        if grown < LEAST:
            return measured
    evidence = axial_evidence(Scene.of(known, views, others), at_end, grown)
    if evidence is None:
        return measured
    along, total = evidence.beyond()
    most = int(np.argmax(total))
    if total[most] - total[-1] < CERTAIN:
        return measured
    shorter, rim = whole.lengthened(at_end, float(along[most]) - grown), 0.0
    end = find_end(Scene.of(shorter, views, others), at_end, -float(along[most]))
    if end is not None:
        shorter, rim = shorter.lengthened(at_end, end.position), end.odds
    rims = (measured.rims[0], rim) if at_end else (rim, measured.rims[1])
    return replace(measured, cylinder=shorter, rims=rims)


def _free_from(
    known: Cylinder, whole: Cylinder, at_end: bool, views: Sequence[View], others: Sequence[Cylinder]
) -> float:
    """How far [m] beyond an end of its known part the views begin to see through a pipe; infinite: nowhere."""
    start, end = (known.end, whole.end) if at_end else (known.start, whole.start)
    stretches = free_stretches(Cylinder(start, end, known.radius), views, others, known)
    return min((low for low, high in stretches if high - low > SEEN_THROUGH), default=np.inf)
