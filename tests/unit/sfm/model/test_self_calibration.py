# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: what a map tells of its camera, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.model.model_adjustment import adjust_model
from pipeprog_sfm.model.self_calibration import Priors, refine
from pipeprog_sfm.model.sparse_model import SparseModel

TRUE = Camera(848, 480, 600.0, 600.0, 423.5, 239.5, "plumb_bob", (0.0, 0.0, 0.0, 0.0))
NOISE = 0.2  # px
VELOCITY_SHIFT = 1.0  # px from the first row to the last: 0.07 rad/s or 0.2 m/s, for a read-out of 15 ms
SIGMAS = np.array([0.003, 0.005, 0.01, 0.0])  # of a calibration; a global shutter


def survey(true: Camera, told: Camera, views: int = 14, points: int = 700) -> tuple[SparseModel, dict[int, Keyframe]]:
    """A camera that walks past a room corner and turns a little; its features undistorted with `told`."""
    rng = np.random.default_rng(5)
    world = rng.uniform([-3, -1.2, 2], [3, 1.2, 4], (points, 3))
    model, keyframes = SparseModel(), {}
    model.points = world.copy()
    for view in range(views):
        share = view / (views - 1)
        yaw = np.radians(25) * np.sin(2 * np.pi * share)
        rotation = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ [3 * (share - 0.5), 0.1 * np.sin(9 * share), 0.4 * np.cos(5 * share)]
        inside = world @ pose[:3, :3].T + pose[:3, 3]
        ideal = inside[:, :2] / inside[:, 2:] * [true.fx, true.fy] + [true.cx, true.cy]
        pixels = true.distort_points(ideal) + NOISE * rng.standard_normal(ideal.shape)
        seen = (inside[:, 2] > 0) & (pixels > 0).all(1) & (pixels < [true.width, true.height]).all(1)
        undistorted = told.undistort_points(pixels[seen]).astype(np.float32)
        keyframe = Keyframe.of(view, Features(undistorted, np.zeros((seen.sum(), 128), np.uint8)), told)
        keyframes[view] = keyframe
        model.add_view(view, keyframe.rays, keyframe.focal, pose)
        model.point_of[model.features(view)] = np.flatnonzero(seen)
    adjust_model(model)
    return model, keyframes


@pytest.mark.parametrize(
    ("focal_error", "k1"), [(0.01, 0.0), (0.0, 0.01), (-0.008, -0.006)], ids=["focal length", "k1", "both"]
)
def test_a_wrong_calibration_is_found(focal_error: float, k1: float) -> None:
    told = replace(TRUE, fx=TRUE.fx * (1 + focal_error), fy=TRUE.fy * (1 + focal_error), distortion=(k1, 0.0, 0.0, 0.0))
    found = refine(*survey(TRUE, told), Priors(told, 0.0, SIGMAS), {})
    assert found is not None
    assert found.is_significant
    assert found.told == told
    assert abs(found.camera.fx / TRUE.fx - 1) < max(3 * found.sigmas[0], 1e-3)
    assert abs(found.camera.distortion[0]) < 1e-3


def test_a_right_calibration_stays() -> None:
    found = refine(*survey(TRUE, TRUE), Priors(TRUE, 0.0, SIGMAS), {})
    assert found is not None
    assert not found.is_significant


def test_what_wrong_velocities_bend_is_no_calibration() -> None:
    """Of a rolling shutter, they stretch and shear each view in a way of its own."""
    rng = np.random.default_rng(0)
    model, keyframes = survey(TRUE, TRUE)
    for view in range(len(model)):
        own = model.features(view)
        rows = model.rays[own, 1:] * TRUE.fy / TRUE.height  # in heights of the image, from its middle
        model.rays[own] += (rows * rng.normal(0.0, VELOCITY_SHIFT, 2) / TRUE.fx).astype(model.rays.dtype)
    adjust_model(model)
    still, rolling = (refine(model, keyframes, Priors(TRUE, readout, SIGMAS), {}) for readout in (0.0, 0.015))
    assert still is not None
    assert still.is_significant  # as it would be if every point erred by itself
    assert rolling is not None
    assert not rolling.is_significant
