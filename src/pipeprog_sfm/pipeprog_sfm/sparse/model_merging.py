# SPDX-License-Identifier: Apache-2.0
"""Two models merged by a keyframe that can be located in both."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.guided_matching import link
from pipeprog_sfm.sparse.localizer import Localizer
from pipeprog_sfm.sparse.registration import LOCAL_WINDOW, MIN_INLIERS, Location
from pipeprog_sfm.sparse.sparse_map import SparseMap

DEPTH_TOLERANCE = 0.05  # relative difference of a point's depth in two models: its noise at the smallest ray angle
CONFIRMED = 3  # views of a model that is merged: nothing confirms a pair, which a read-out not known may have bent
AGREEING = 0.5  # share of the points of two models whose depths agree: with fewer one of the models is bent


def merge_models(sparse_map: SparseMap, localizer: Localizer, stamp: int) -> list[int]:
    """Merges the keyframe's model with another one in which the keyframe can be located as well.

    Of two models that see the same points at other depths the smaller one, made of fewer views, is given up; so is a
    pair that no third view has confirmed. Returns the stamps of its keyframes, which wait to be registered anew; mostly
    none.
    """
    own = sparse_map.model_of(stamp)
    if own is None:
        return []
    keyframe = sparse_map.keyframes[stamp]
    for other in [model for model in sparse_map.models if model is not own]:
        similar = localizer.next_similar_views(other, keyframe)
        if not len(similar):
            continue
        location = localizer.locate_by(other, keyframe, similar)
        view = own.stamps.index(stamp)
        found = similarity_between(own, view, other, location)
        is_confirmed = min(len(own), len(other)) >= CONFIRMED
        if found is not None and is_confirmed:
            removed, merged = merge(own, other, *found)
            sparse_map.models = [model for model in sparse_map.models if model is not removed]
            _connect(sparse_map, removed, merged, stamp)
            return []
        if found is not None or len(_depths(own, view, other, location)) >= MIN_INLIERS / AGREEING:
            return sparse_map.give_up(min(own, other, key=len))
    return []


def _connect(sparse_map: SparseMap, removed: SparseModel, merged: SparseModel, stamp: int) -> None:
    """Matches the views of the removed model with those of the merged one, and adjusts it.

    First the views nearest in time to the keyframe that both models saw: only there do the poses agree well enough
    for guided matching before the first adjustment.
    """
    near = sorted(range(len(merged)), key=lambda view: abs(merged.stamps[view] - stamp))[: 2 * LOCAL_WINDOW]
    for view in near:
        link(merged, view, sparse_map.keyframes)
    sparse_map.adjust_globally(merged)
    for moved in removed.stamps:
        if moved in merged.stamps:
            link(merged, merged.stamps.index(moved), sparse_map.keyframes)
    sparse_map.adjust_globally(merged)


def similarity_between(
    source: SparseModel, view: int, target: SparseModel, location: Location
) -> tuple[float, FloatArray] | None:
    """Scale and rigid target_from_source (4, 4), applied after it, by a view of the source located in the target.

    None where it was not located, or the depths of the points that both see through this view do not agree.
    """
    own, theirs = _depths(source, view, target, location).T
    pose = location.camera_from_model
    if pose is None or not len(own):
        return None
    ratio = theirs / own
    scale = float(np.median(ratio))
    if scale <= 0 or (np.abs(ratio / scale - 1) < DEPTH_TOLERANCE).sum() < max(MIN_INLIERS, AGREEING * len(ratio)):
        return None
    own_pose = source.pose(view)
    own_pose[:3, 3] *= scale
    return scale, np.linalg.inv(pose) @ own_pose


def _depths(source: SparseModel, view: int, target: SparseModel, location: Location) -> FloatArray:
    """(K, 2) depths in both models of the points that both see through a view of the source located in the target."""
    if location.camera_from_model is None:
        return np.empty((0, 2))
    used = location.pairs
    mine = source.point_of[source.offsets[view] + used[:, 0]]
    sides = (source, mine, source.pose(view)), (target, used[:, 1], location.camera_from_model)
    return np.stack([model.points[ids] @ pose[2, :3] + pose[2, 3] for model, ids, pose in sides], axis=1)[mine >= 0]


def merge(
    source: SparseModel, target: SparseModel, scale: float, target_from_source: FloatArray
) -> tuple[SparseModel, SparseModel]:
    """Takes the smaller model into the larger one; returns the smaller one, as it was, and the larger one."""
    if len(source) > len(target):
        source, target = target, source
        scale = 1 / scale
        target_from_source = np.asarray(np.linalg.inv(target_from_source), np.float64)
        target_from_source[:3, 3] *= scale
    target.absorb(source, scale, target_from_source)
    return source, target
