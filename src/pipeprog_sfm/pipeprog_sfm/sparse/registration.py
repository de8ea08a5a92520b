# SPDX-License-Identifier: Apache-2.0
"""Registration of a keyframe in a model: its pose from the map's points, its tracks, and the check of the pose."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray
from pipeprog_sfm.model.model_adjustment import adjust_model, adjust_views
from pipeprog_sfm.model.row_motion import near_in_time, row_motions, unroll
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.colmap import AbsolutePose, absolute_pose
from pipeprog_sfm.sparse.guided_matching import link

POSE_ERROR = 4.0  # px, inlier threshold of RANSAC: points are off by a pixel or two before they are adjusted
MIN_INLIERS = 20  # of a pose: by chance one match in 18 000 lies within 4 px (of 1280 x 720)
RIVAL = 0.5  # of a pose's inliers: if this share agrees on another pose, repeated texture makes the pose ambiguous
MIN_SHARE = 0.25  # of the matches with the neighbours that must agree with a pose: a wrong pose has few per cent
LOCAL_WINDOW = 8  # views that local bundle adjustment moves: those that see a point at 80 % overlap, and some more
# Of the share of features with a point that the views around it in time have, the part below which a view's velocity,
# and so its pose, may be wrong: with the velocity off by 0.7 m/s (read-out 30 ms, a path that turned) it had 0.4.
DOUBTFUL, AROUND = 0.6, 4
# Of the views of a trajectory, the most that may hang on by few points: before the read-out was found, seven of 39 had
# turned away together. More may be of another room.
PIECE = 0.25
# Of the points that the views before and after a moment share, usually; with less, a few views at an end may have poses
# and velocities of their own: 0.15 was seen at 1.4 m/s and 20 ms (two views 0.8 m off), 0.5 at ends and in turns.
LOOSE = 0.3
MOVED = 3  # views, with the new one, whose velocities a new view changes by more than a quarter of its own change


@dataclass(frozen=True)
class Location:
    """A keyframe's pose (4, 4) in a model (None: the reason says why), and its (K, 2) feature and point pairs."""

    camera_from_model: FloatArray | None
    pairs: IntArray
    reason: str


def locate(model: SparseModel, keyframe: Keyframe, matches: Mapping[int, MatchArray], seed: int) -> Location:
    """Pose by the map points that other views see; matches: of the keyframe with each of these, by stamp."""
    pairs = []
    for stamp, found in matches.items():
        offset = model.offsets[model.stamps.index(stamp)]
        pairs.append(np.stack([found[:, 0], model.point_of[offset + found[:, 1]]], axis=1))
    known = np.concatenate(pairs)
    known = np.unique(known[known[:, 1] >= 0], axis=0)
    pose = _absolute_pose(model, keyframe, known, seed)
    if pose is None or pose.inliers.sum() < MIN_INLIERS:
        agreeing = 0 if pose is None else int(pose.inliers.sum())
        return Location(None, known[:0], f"only {agreeing} of {len(known)} matches agree on a pose")
    rest = known[~pose.inliers]
    if len(rest) >= RIVAL * pose.inliers.sum():
        rival = _absolute_pose(model, keyframe, rest, seed)
        if rival is not None and rival.inliers.sum() >= RIVAL * pose.inliers.sum():
            reason = f"{pose.inliers.sum()} matches agree on a pose and {rival.inliers.sum()} on another one"
            return Location(None, known[:0], reason)
    return Location(pose.camera_from_model, known[pose.inliers], "")


def add_view(
    model: SparseModel,
    keyframe: Keyframe,
    location: Location,
    keyframes: MutableMapping[int, Keyframe],
    readout: float = 0.0,
) -> int:
    """Adds a located keyframe: its pose, then tracks and local adjustment; returns its view.

    keyframes: at least those of the model's views and this one, by stamp; with a readout [s], this one and its
    neighbours get the features of the middle row's camera.
    """
    assert location.camera_from_model is not None
    used = location.pairs
    view = model.add_view(keyframe.stamp, keyframe.rays, keyframe.focal, location.camera_from_model)
    first = np.unique(used[:, 0], return_index=True)[1]
    model.point_of[model.offsets[view] + used[first, 0]] = used[first, 1]
    if readout:
        near = near_in_time(model, keyframe.stamp)
        unroll(model, keyframes, row_motions(model, keyframes, readout, near, MOVED).of_all())
    link(model, view, keyframes)
    _adjust_around(model, view)
    return view


def rejection_reason(model: SparseModel, view: int, matches: Mapping[int, MatchArray]) -> str:
    """Why a pose is rejected: too few points, or matches (by stamp) that contradict it; empty if it is accepted."""
    points = len(model.seen(view))
    if points < MIN_INLIERS:
        return f"only {points} points hold its pose"
    errors = [
        epipolar_errors(model, view, model.stamps.index(other), found)
        for other, found in matches.items()
        if other in model.stamps
    ]
    error = np.concatenate(errors) if errors else np.empty(0)
    share = float((error < POSE_ERROR).mean()) if len(error) else 1.0
    if share < MIN_SHARE:
        return f"only {share:.0%} of the matches with its neighbours agree with its pose"
    return ""


def doubtful_views(model: SparseModel, keyframes: Mapping[int, Keyframe]) -> list[int]:
    """Views that hang on by few points, or whose features have far fewer of them than those of views around.

    These are the `AROUND` views of their camera nearest in time; what is compared is the share of the features, as
    some views have fewer than others.

    With a rolling shutter a view that is registered before what follows it may take a wrong velocity where the camera
    turns; features that are unrolled by it agree with a wrong pose, which confirms the velocity. Views in a row may do
    so together: they share points with each other, and few with the rest.
    keyframes: at least those of the model's views, by stamp.
    """
    frames = np.array([keyframes[stamp].frame for stamp in model.stamps])
    stamps = np.array(model.stamps)
    doubtful: set[int] = set()
    for frame in np.unique(frames):
        own = np.flatnonzero(frames == frame)
        own = own[np.argsort(stamps[own])]
        seen = [model.seen(view) for view in own]
        held = np.array([(model.point_of[model.features(view)] >= 0).mean() for view in own])
        for number, view in enumerate(own.tolist()):
            others = np.delete(np.arange(len(own)), number)
            near = others[np.argsort(np.abs(stamps[own[others]] - stamps[view]), kind="stable")[:AROUND]]
            if len(near) and held[number] < DOUBTFUL * np.median(held[near]):
                doubtful.add(view)
        for piece in _pieces(seen):
            if len(piece) <= max(AROUND, PIECE * len(own)) and 2 * len(piece) < len(own):
                doubtful.update(own[piece].tolist())
    return sorted(doubtful)


def _pieces(seen: Sequence[IntArray]) -> list[IntArray]:
    """A trajectory cut where views share few points across a moment; `seen`: the points of each view in order."""
    shared = np.array([_shared(seen[max(now - AROUND, 0) : now], seen[now:][:AROUND]) for now in range(1, len(seen))])
    return np.split(np.arange(len(seen)), np.flatnonzero(shared < LOOSE * np.median(shared)) + 1 if len(shared) else [])


def _shared(before: Sequence[IntArray], after: Sequence[IntArray]) -> float:
    """The points that two groups of views share, as a share of those of the one that sees fewer."""
    one, other = np.unique(np.concatenate(before)), np.unique(np.concatenate(after))
    return len(np.intersect1d(one, other, assume_unique=True)) / max(min(len(one), len(other)), 1)


def epipolar_errors(model: SparseModel, view: int, other: int, matches: MatchArray) -> FloatArray:
    """Distances in px of the features of `other` from the epipolar lines of those of `view`; matches (M, 2)."""
    rotation = model.rotation[other] @ model.rotation[view].T
    tx, ty, tz = model.translation[other] - rotation @ model.translation[view]
    essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ rotation
    own = model.rays[model.offsets[view] + matches[:, 0]]
    theirs = model.rays[model.offsets[other] + matches[:, 1]]
    line = np.c_[own, np.ones(len(own))] @ essential.T
    residual = (line * np.c_[theirs, np.ones(len(theirs))]).sum(axis=1)
    return np.abs(residual) / np.maximum(np.hypot(*(line[:, :2] / model.focal[other]).T), 1e-12)


def _absolute_pose(model: SparseModel, keyframe: Keyframe, pairs: IntArray, seed: int) -> AbsolutePose | None:
    pixels, points = keyframe.features.keypoints[pairs[:, 0]], model.points[pairs[:, 1]]
    return absolute_pose(pixels, points, keyframe.camera, POSE_ERROR, seed)


def _adjust_around(model: SparseModel, view: int) -> None:
    """Adjusts a view together with the views that share most points with it."""
    shared = model.covisible(np.array([view]))[0]
    window = np.argsort(-shared, kind="stable")[: LOCAL_WINDOW - 1]
    window = np.append(window[shared[window] > 0], view)
    if len(model) <= LOCAL_WINDOW:
        adjust_model(model)
    else:
        adjust_views(model, window)
