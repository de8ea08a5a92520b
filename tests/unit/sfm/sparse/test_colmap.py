# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_sfm.sparse.colmap import absolute_pose, relative_pose

# Wide beside its focal length, so that half a pixel is a turn that no pose hides.
CAMERA = Camera(320, 240, 200.0, 210.0, 159.5, 119.5)


def scene(seed):
    """Points (N, 3) before two cameras, the second's pose camera_from_model, and the pixels in both."""
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(-1.5, 1.5, (200, 2)), rng.uniform(2.0, 5.0, 200)]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, 0.3, 3)
    return points, pose, [project(points, camera_from_model) for camera_from_model in (np.eye(4), pose)]


def project(points, camera_from_model):
    x, y, z = camera_from_model[:3, :3] @ points.T + camera_from_model[:3, 3:]
    return np.c_[CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**16))
def test_exact_pixels_give_the_exact_pose(seed):
    points, pose, (_, pixels) = scene(seed)
    found = absolute_pose(pixels, points, CAMERA, 1.0, seed)
    assert found is not None
    assert found.inliers.all()
    np.testing.assert_allclose(found.camera_from_model, pose, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**16))
def test_exact_matches_give_the_exact_relative_pose(seed):
    _, pose, (before, after) = scene(seed)
    found = relative_pose(before, after, CAMERA, CAMERA, 1.0, seed)
    assert found is not None
    np.testing.assert_allclose(found.b_from_a[:3, :3], pose[:3, :3], atol=1e-4)
    direction = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    assert found.b_from_a[:3, 3] @ direction == pytest.approx(1.0, abs=1e-5)
