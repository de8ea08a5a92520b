# SPDX-License-Identifier: Apache-2.0
"""A new model, started from two keyframes."""

from __future__ import annotations

import numpy as np

from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray
from pipeprog_sfm.model.model_adjustment import adjust_model
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.colmap import relative_pose
from pipeprog_sfm.sparse.guided_matching import link
from pipeprog_sfm.sparse.registration import POSE_ERROR

START_POINTS = 40  # of a new model: twice the inliers that a pose must have
START_ITERATIONS, START_TOLERANCE = 20, 1e-4  # of the adjustment: farther from the minimum than a map that grows
START_ANGLE = np.radians(3.0)  # median between the rays of its points: depths are then known to some 2 % at 1 px


def model_from_pair(first: Keyframe, second: Keyframe, matches: MatchArray, seed: int) -> SparseModel | None:
    """The model that two keyframes with (M, 2) matches give; None: too few points, or depths too uncertain.

    The first one is its origin, and the distance between the two its unit.
    """
    if len(matches) < START_POINTS:
        return None
    pixels, other_pixels = first.features.keypoints[matches[:, 0]], second.features.keypoints[matches[:, 1]]
    pose = relative_pose(pixels, other_pixels, first.camera, second.camera, 0.5 * POSE_ERROR, seed)
    if pose is None or pose.inliers.sum() < START_POINTS:
        return None
    model = SparseModel()
    model.add_view(first.stamp, first.rays, first.focal, np.eye(4))
    view = model.add_view(second.stamp, second.rays, second.focal, pose.b_from_a)
    pairs = matches[pose.inliers].astype(np.int64)
    pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
    model.link(pairs[:, 1] + model.offsets[view], pairs[:, 0])
    adjust_model(model, START_ITERATIONS, START_TOLERANCE)
    link(model, view, {first.stamp: first, second.stamp: second})
    adjust_model(model, START_ITERATIONS, START_TOLERANCE)
    ids, _, _ = model.observations(np.ones(len(model.points), bool))
    if len(ids) < START_POINTS:
        return None
    rays = model.points[ids, None] - model.centres()[None]
    cosine = (rays[:, 0] * rays[:, 1]).sum(axis=1) / np.linalg.norm(rays, axis=2).prod(axis=1)
    angle = np.median(np.arccos(np.clip(cosine, -1, 1)))
    return model if angle > START_ANGLE else None
