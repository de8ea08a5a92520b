# SPDX-License-Identifier: Apache-2.0
"""Guided matching: a registered view is matched along epipolar segments with the views that see the same place."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray, match_guided
from pipeprog_sfm.model.sparse_model import SparseModel

GUIDED_RADIUS = 4.0  # px around the epipolar segment, as POSE_ERROR: poses are known to a pixel or two
TEMPORAL = 3  # nearest in time of its camera, always matched with: at 80 % overlap they see nearly the same
COVISIBLE = 5  # further views, those of the largest predicted overlap: a constant cost per keyframe
MIN_OVERLAP = 0.3  # share of the sampled points that such a view must see: fewer give few new matches for the cost
MAX_ANGLE = np.radians(40)  # between optical axes: SIFT matches a patch seen from up to some 40 degrees aside
MAX_SCALE = 2.0  # ratio of depths: SIFT matches a patch at up to twice the scale
# The depth range of a view, for features without a point: half the 2nd and twice the 98th percentile of the depths of
# its points, as surfaces without features lie outside of the range of the points.
DEPTH_PERCENTILES, DEPTH_MARGIN = (2, 98), 2.0
DEPTH_TOLERANCE = 0.05  # of the depth of a point around which its match is sought: its noise at the smallest angle
SAMPLE = 50  # points from which overlap with every other view is predicted: its error is sqrt(0.25 / 50) = 0.07


def link(model: SparseModel, view: int, keyframes: Mapping[int, Keyframe]) -> None:
    """Matches a view with its neighbours in time and with those that look at the same place, by the poses.

    keyframes: at least those of the model's views, by stamp.
    """
    _link_with(model, view, keyframes, partners)


def link_among(model: SparseModel, view: int, others: IntArray, keyframes: Mapping[int, Keyframe]) -> None:
    """As `link`, with those of the `others` (views) alone that look at the same place."""

    def among(model: SparseModel, view: int, keyframes: Mapping[int, Keyframe]) -> list[int]:
        score = np.zeros(len(model))
        score[others] = _overlaps(model, view, keyframes)[others]
        return _best(score)

    _link_with(model, view, keyframes, among)


def partners(model: SparseModel, view: int, keyframes: Mapping[int, Keyframe]) -> list[int]:
    """Neighbours in time, then the views that see most of the view's points from a similar direction and distance.

    keyframes: at least those of the model's views, by stamp.
    """
    gap = np.abs(np.array(model.stamps) - model.stamps[view])
    frames = [keyframes[stamp].frame for stamp in model.stamps]
    never = np.iinfo(np.int64).max
    gap[[other == view or frame != frames[view] for other, frame in enumerate(frames)]] = never
    temporal = [int(other) for other in np.argsort(gap, kind="stable")[:TEMPORAL] if gap[other] < never]
    score = _overlaps(model, view, keyframes)
    score[[view, *temporal]] = 0.0
    return temporal + _best(score)


def _link_with(
    model: SparseModel,
    view: int,
    keyframes: Mapping[int, Keyframe],
    choose: Callable[[SparseModel, int, Mapping[int, Keyframe]], list[int]],
) -> None:
    seen = model.seen(view)
    depth = model.points[seen] @ model.rotation[view, 2] + model.translation[view, 2]
    depth = depth[depth > 0]
    if not len(depth):
        return
    near, far = np.percentile(depth, DEPTH_PERCENTILES)
    depth_range = float(near / DEPTH_MARGIN), float(DEPTH_MARGIN * far)
    features, others = [], []
    for other in choose(model, view, keyframes):
        found = _match_guided(model, view, other, keyframes, depth_range)
        features.append(found[:, 0] + model.offsets[view])
        others.append(found[:, 1] + model.offsets[other])
    if not features:
        return
    feature, other_feature = np.concatenate(features).astype(np.int64), np.concatenate(others).astype(np.int64)
    order = np.lexsort((other_feature, feature))
    model.link(feature[order], other_feature[order])


def _overlaps(model: SparseModel, view: int, keyframes: Mapping[int, Keyframe]) -> FloatArray:
    """(V,) share of the view's points that each view sees from a similar direction and distance."""
    seen = model.seen(view)
    sample = model.points[seen[:: max(len(seen) // SAMPLE, 1)]]
    # One matrix product, coordinate by coordinate: the only step whose cost grows with the number of views.
    inside = (model.rotation.reshape(-1, 3) @ sample.T).reshape(len(model), 3, -1) + model.translation[..., None]
    depth = inside[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = inside[:, 0] / depth, inside[:, 1] / depth
    cameras = [keyframes[stamp].camera for stamp in model.stamps]
    reach = np.array([(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy) for camera in cameras])
    visible = (depth > 0) & (np.abs(u) < reach[:, :1]) & (np.abs(v) < reach[:, 1:])
    own = depth[view]
    visible &= (depth < MAX_SCALE * own) & (MAX_SCALE * depth > own)
    similar = model.rotation[:, 2] @ model.rotation[view, 2] > np.cos(MAX_ANGLE)
    return np.where(similar, visible.mean(axis=1), 0.0)


def _best(score: FloatArray) -> list[int]:
    best = np.argsort(-score, kind="stable")[:COVISIBLE]
    return [int(other) for other in best if score[other] > MIN_OVERLAP]


def _match_guided(
    model: SparseModel, view: int, other: int, keyframes: Mapping[int, Keyframe], depth_range: tuple[float, float]
) -> MatchArray:
    """Matches along the epipolar segment between two depths; a feature with a point is sought near its projection."""
    mine, theirs = keyframes[model.stamps[view]], keyframes[model.stamps[other]]
    rotation = model.rotation[other] @ model.rotation[view].T
    translation = model.translation[other] - rotation @ model.translation[view]
    low = np.full(len(mine.rays), depth_range[0])
    high = np.full(len(mine.rays), depth_range[1])
    own = model.point_of[model.features(view)]
    has = own >= 0
    depth = model.points[own[has]] @ model.rotation[view, 2] + model.translation[view, 2]
    low[has], high[has] = (1 - DEPTH_TOLERANCE) * depth, (1 + DEPTH_TOLERANCE) * depth
    direction = np.c_[mine.rays, np.ones(len(mine.rays))] @ rotation.T
    focal, centre = theirs.focal, np.array([theirs.camera.cx, theirs.camera.cy])
    ends = []
    for distance in (low, high):
        inside = direction * distance[:, None] + translation
        pixel = np.full((len(inside), 2), np.nan)
        front = inside[:, 2] > 0.1 * distance
        pixel[front] = inside[front, :2] / inside[front, 2:] * focal + centre
        ends.append(pixel)
    return match_guided(
        mine.features.descriptors, ends[0], ends[1],
        theirs.features.descriptors, theirs.features.keypoints, GUIDED_RADIUS,
    )  # fmt: skip
