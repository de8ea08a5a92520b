# SPDX-License-Identifier: Apache-2.0
"""Overlap of each keyframe with the map, Eq. 1 of the paper, reported when it changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import IntArray
from pipeprog_sfm.features.keyframe import Keyframe, grid_cells, hull_area
from pipeprog_sfm.sparse.sparse_model import SparseModel

NO_STAMP = -1


@dataclass(frozen=True)
class OverlapReport:
    """Overlap of a keyframe with the map: Eq. 1 of the paper (hull areas) and the share of 32 x 18 cells."""

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    tie_points: int
    features: int
    matches_previous: int
    matches_next: int


class OverlapTracker:
    """Remembers for which points of the map the overlap of each keyframe was last reported."""

    def __init__(self) -> None:
        self._reported: dict[int, tuple[int | None, int, int | None]] = {}

    def forget(self, stamp: int) -> None:
        """Forgets a keyframe: if it is added again, its overlap is reported again."""
        self._reported.pop(stamp, None)

    def changed(self, keyframes: Mapping[int, Keyframe], model: SparseModel) -> list[OverlapReport]:
        """Overlap of the keyframes, by stamp, for which it changed since the last call."""
        view_of = {stamp: view for view, stamp in enumerate(model.stamps)}
        tied = {stamp: model.features(view) for stamp, view in view_of.items()}
        digests = model.digests().tolist()
        marks = {stamp: digests[view_of[stamp]] if stamp in view_of else 0 for stamp in keyframes}
        changed = []
        for before, stamp, after in _in_time(keyframes):
            mark = (marks.get(before), marks[stamp], marks.get(after))
            if self._reported.get(stamp) != mark:
                self._reported[stamp] = mark
                near = (model.point_of[tied[one]] if one in tied else None for one in (before, stamp, after))
                changed.append(_report(keyframes[stamp], *near))
        return changed


def _in_time(keyframes: Mapping[int, Keyframe]) -> list[tuple[int, int, int]]:
    """Stamps in order of time, each between those before and after it of the same camera."""
    found: list[tuple[int, int, int]] = []
    for frame in {keyframe.frame for keyframe in keyframes.values()}:
        stamps = sorted(stamp for stamp, keyframe in keyframes.items() if keyframe.frame == frame)
        found += zip([NO_STAMP, *stamps[:-1]], stamps, [*stamps[1:], NO_STAMP], strict=True)
    return sorted(found, key=lambda around: around[1])


def _report(keyframe: Keyframe, before: IntArray | None, own: IntArray | None, after: IntArray | None) -> OverlapReport:
    """Overlap of a keyframe by the points of its features and of its neighbours'; None: not registered."""
    keypoints = keyframe.measured  # the hull of all features is that of the image as it is
    inside = keypoints[:0] if own is None else keypoints[own >= 0]
    size = keyframe.camera.width, keyframe.camera.height
    return OverlapReport(
        keyframe.stamp,
        own is not None,
        hull_area(inside) / max(keyframe.hull, 1e-9),
        grid_cells(inside, size) / max(keyframe.cells, 1),
        len(inside),
        len(keypoints),
        _common(before, own),
        _common(own, after),
    )


def _common(points: IntArray | None, others: IntArray | None) -> int:
    """Points that two views both see."""
    if points is None or others is None:
        return 0
    return len(np.intersect1d(points[points >= 0], others[others >= 0]))
