"""A registered view tied to the others: matched along epipolar segments with those that look at the same place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_sfm.sparse.keyframe import Keyframe
from pipeprog_sfm.sparse.matching import MatchArray, match_guided
from pipeprog_sfm.sparse.sparse_model import SparseModel

GUIDED_RADIUS = 4.0  # px around the epipolar segment
TEMPORAL = 3  # neighbours in time that every keyframe is matched with
COVISIBLE = 5  # further views by predicted overlap
SAMPLE = 50  # points that tell the overlap with every other view, to a fifteenth


def link(model: SparseModel, view: int, keyframes: Mapping[int, Keyframe]) -> None:
    """Matches a view with its neighbours in time and with those that look at the same place, by the poses.

    keyframes: at least those of the model's views, by stamp.
    """
    seen = model.seen(view)
    depth = model.points[seen] @ model.rotation[view, 2] + model.translation[view, 2]
    depth = depth[depth > 0]
    if not len(depth):
        return
    depth_range = float(0.5 * np.percentile(depth, 2)), float(2.0 * np.percentile(depth, 98))
    features, others = [], []
    for other in partners(model, view, keyframes[model.stamps[view]].camera):
        found = _match_guided(model, view, other, keyframes, depth_range)
        features.append(found[:, 0] + model.offsets[view])
        others.append(found[:, 1] + model.offsets[other])
    if not features:
        return
    feature, other_feature = np.concatenate(features).astype(np.int64), np.concatenate(others).astype(np.int64)
    order = np.lexsort((other_feature, feature))
    model.link(feature[order], other_feature[order])


def partners(model: SparseModel, view: int, camera: Camera) -> list[int]:
    """Neighbours in time, then the views into which most of the view's points project from a like direction.

    camera: of the view, and taken for that of the others.
    """
    gap = np.abs(np.array(model.stamps) - model.stamps[view])
    gap[view] = np.iinfo(np.int64).max
    temporal = [int(other) for other in np.argsort(gap, kind="stable")[:TEMPORAL] if other != view]
    seen = model.seen(view)
    sample = model.points[seen[:: max(len(seen) // SAMPLE, 1)]]
    # One product of matrices, coordinate by coordinate: this is all that looks at every view of the map.
    inside = (model.rotation.reshape(-1, 3) @ sample.T).reshape(len(model), 3, -1) + model.translation[..., None]
    depth = inside[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = inside[:, 0] / depth, inside[:, 1] / depth
    visible = (depth > 0) & (np.abs(u) < 0.5 * camera.width / camera.fx)
    visible &= np.abs(v) < 0.5 * camera.height / camera.fy
    # SIFT finds a patch again when it is seen from within some 40 degrees and at up to twice the scale.
    own = depth[view]
    visible &= (depth < 2 * own) & (2 * depth > own)
    alike = model.rotation[:, 2] @ model.rotation[view, 2] > np.cos(np.radians(40))
    score = np.where(alike, visible.mean(axis=1), 0.0)
    score[[view, *temporal]] = 0.0
    best = np.argsort(-score, kind="stable")[:COVISIBLE]
    return temporal + [int(other) for other in best if score[other] > 0.3]


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
    low[has], high[has] = 0.95 * depth, 1.05 * depth
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
