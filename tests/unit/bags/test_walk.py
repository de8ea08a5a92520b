# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sitegen.walk import Walk, look

ANGLE = st.floats(-1.2, 1.2)


@given(ANGLE, ANGLE, ANGLE)
def test_poses_are_rigid_and_right_handed(yaw: float, pitch: float, roll: float) -> None:
    pose = look([1.0, 2.0, 3.0], yaw, pitch, roll)[0]
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.isclose(np.linalg.det(pose[:3, :3]), 1.0)
    assert np.isclose(pose[2, 2], np.sin(pitch))


def test_the_optical_frame_looks_at_the_wall_with_its_feet_down() -> None:
    pose = look([0.0, -2.0, 1.5], 0.0, 0.0, 0.0)[0]
    assert np.allclose(pose[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_the_walk_keeps_its_speed_and_passes_its_ends() -> None:
    points = [[0.0, -2, 1, 0, 0], [1.0, -2.2, 1.2, 0, 0], [3.0, -2, 1, 0, 0]]
    walk = Walk(points, 0.5, np.random.default_rng(1), closed=False, wobble=0.0)
    times = np.linspace(0.0, walk.duration, 400)
    positions = walk.poses(times)[:, :3, 3]
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
    assert np.allclose(speed, 0.5, rtol=0.01)
    assert np.allclose(positions[[0, -1]], [points[0][:3], points[-1][:3]], atol=1e-6)


def test_a_closed_walk_comes_round() -> None:
    points = [[0.0, -2, 1, 0, 0], [1.0, -2, 1, 0.1, 0], [1.0, -2, 2, 0, 0]]
    walk = Walk(points, 0.5, np.random.default_rng(1), closed=True, wobble=0.0)
    there, back = walk.poses([0.7, 0.7 + walk.duration])
    assert np.allclose(there, back, atol=1e-6)


def test_the_hand_shakes_as_much_as_asked() -> None:
    points = [[0.0, -2, 1, 0, 0], [3.0, -2, 1, 0, 0]]
    still, shaky = (Walk(points, 0.5, np.random.default_rng(1), closed=False, wobble=w) for w in (0.0, 1.0))
    times = np.linspace(0.0, 6.0, 200)
    apart = np.linalg.norm(still.poses(times)[:, :3, 3] - shaky.poses(times)[:, :3, 3], axis=1)
    assert 0.01 < apart.max() < 0.08
