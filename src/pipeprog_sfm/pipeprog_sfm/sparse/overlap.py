# SPDX-License-Identifier: Apache-2.0
"""Overlap of each keyframe with the map, Eq. 1 of the paper, reported when it changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import IntArray
from pipeprog_camera.view_overlap import sample, view_overlap
from pipeprog_sfm.features.keyframe import Keyframe, grid_cells, hull_area
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.registration import LOCAL_WINDOW, MIN_INLIERS

NO_STAMP = -1
# Views of earlier visits that show the same, from which on another one adds little: one visit, where the keyframes of
# neighbouring places overlap by 0.85, has two of them within 0.875. As many as ORB-SLAM asks for (Mur-Artal, TRO 2015).
SEEN_BEFORE = 3


@dataclass(frozen=True)
class OverlapReport:
    """Overlap of a keyframe with the map: Eq. 1 of the paper (hull areas) and the share of 32 x 18 cells.

    place_overlap: see `place_overlap`.
    """

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    tie_points: int
    features: int
    matches_previous: int
    matches_next: int
    place_overlap: float = 0.0


class OverlapTracker:
    """Remembers for which points of the map the overlap of each keyframe was last reported."""

    def __init__(self) -> None:
        self._reported: dict[int, tuple[int | None, int, int | None]] = {}

    def forget(self, stamp: int) -> None:
        """Forgets a keyframe: if it is added again, its overlap is reported again."""
        self._reported.pop(stamp, None)

    def changed(self, keyframes: Mapping[int, Keyframe], model: SparseModel, places: bool) -> list[OverlapReport]:
        """Overlap of the keyframes, by stamp, for which it changed since the last call; `places`: that with places."""
        view_of = {stamp: view for view, stamp in enumerate(model.stamps)}
        digests = model.digests().tolist()
        marks = {stamp: digests[view_of[stamp]] if stamp in view_of else 0 for stamp in keyframes}
        changed = []
        for before, stamp, after in _in_time(keyframes):
            mark = (marks.get(before), marks[stamp], marks.get(after))
            if self._reported.get(stamp) != mark:
                self._reported[stamp] = mark
                changed.append((before, stamp, after))
        views = np.array([view_of[stamp] for _, stamp, _ in changed if stamp in view_of], np.int64)
        shares = dict(zip(views.tolist(), model.covisible(views), strict=True))
        reports = []
        for before, stamp, after in changed:
            view = view_of.get(stamp)
            if view is None:
                reports.append(_report(keyframes[stamp], None, 0, 0))
                continue
            shared = shares[view]
            previous, following = (int(shared[view_of[one]]) if one in view_of else 0 for one in (before, after))
            report = _report(keyframes[stamp], model.point_of[model.features(view)], previous, following)
            if places:
                report = replace(report, place_overlap=place_overlap(model, view, shared, keyframes))
            reports.append(report)
        return reports


def place_overlap(model: SparseModel, view: int, shared: IntArray, keyframes: Mapping[int, Keyframe]) -> float:
    """The share of what a view shows that each of SEEN_BEFORE views of earlier visits shows from the same side.

    These are more than LOCAL_WINDOW views of each camera before it, and tied to it by points in common: `shared` (V,)
    tells how many each view has.
    keyframes: at least those of the model's views, by stamp.
    """
    rank = np.argsort(np.argsort(model.stamps))
    cameras = len({keyframes[stamp].frame for stamp in model.stamps})
    earlier = np.flatnonzero(rank < rank[view] - LOCAL_WINDOW * cameras)
    earlier = earlier[shared[earlier] >= MIN_INLIERS]
    others = [(model.pose(other), keyframes[model.stamps[other]].camera) for other in earlier]
    if len(others) < SEEN_BEFORE:
        return 0.0
    shares = view_overlap(sample(model.points[model.seen(view)]), model.pose(view), others)
    return float(np.sort(shares)[-SEEN_BEFORE])


def _in_time(keyframes: Mapping[int, Keyframe]) -> list[tuple[int, int, int]]:
    """Stamps in order of time, each between those before and after it of the same camera."""
    found: list[tuple[int, int, int]] = []
    for frame in {keyframe.frame for keyframe in keyframes.values()}:
        stamps = sorted(stamp for stamp, keyframe in keyframes.items() if keyframe.frame == frame)
        found += zip([NO_STAMP, *stamps[:-1]], stamps, [*stamps[1:], NO_STAMP], strict=True)
    return sorted(found, key=lambda around: around[1])


def _report(keyframe: Keyframe, own: IntArray | None, previous: int, following: int) -> OverlapReport:
    """Overlap of a keyframe by the points of its features, of which it shares some with its neighbours.

    own: None: not registered.
    """
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
        previous,
        following,
    )
