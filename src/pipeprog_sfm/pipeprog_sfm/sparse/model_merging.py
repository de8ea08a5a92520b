"""Two models made one, by a keyframe that has a place in both."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.sparse.registration import MIN_INLIERS, Location
from pipeprog_sfm.sparse.sparse_model import SparseModel

DEPTH_TOLERANCE = 0.05  # of a point's depth in two models: its noise at the smallest angle


def similarity_between(
    source: SparseModel, view: int, target: SparseModel, location: Location
) -> tuple[float, FloatArray] | None:
    """Scale and rigid target_from_source (4, 4), applied after it, by a view of the source located in the target.

    None where it was not located, or the depths of the points that both see through this view do not agree.
    """
    pose = location.camera_from_model
    if pose is None:
        return None
    used = location.pairs
    mine = source.point_of[source.offsets[view] + used[:, 0]]
    used, mine = used[mine >= 0], mine[mine >= 0]
    own_pose = source.pose(view)
    depth = source.points[mine] @ own_pose[2, :3] + own_pose[2, 3]
    ratio = (target.points[used[:, 1]] @ pose[2, :3] + pose[2, 3]) / depth
    scale = float(np.median(ratio)) if len(ratio) else 0.0
    if scale <= 0 or (np.abs(ratio / scale - 1) < DEPTH_TOLERANCE).sum() < MIN_INLIERS:
        return None
    own_pose[:3, 3] *= scale
    return scale, np.linalg.inv(pose) @ own_pose


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
