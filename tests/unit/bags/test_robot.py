# SPDX-License-Identifier: Apache-2.0
"""What the generated robot tells, against the walk that it tells of."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitegen.robot import BASE_FROM_CAMERA, GRAVITY, Robot, robot_messages
from sitegen.walk import Walk

WAYPOINTS = [(0.0, 0.0, 1.5, 0.0, 0.0), (2.0, 0.3, 1.6, 0.2, 0.05), (4.0, 0.0, 1.5, -0.2, 0.0)]
EXACT = Robot(odometry_noise=0.0, imu_bias=0.0, imu_noise=0.0)


def told(robot, seconds=4.0):
    walk = Walk(WAYPOINTS, 0.75, np.random.default_rng(1), False, 1.0)
    return walk, list(robot_messages(walk, robot, seconds, 10**18, np.random.default_rng(2)))


def pose(place, turn):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([turn[axis] for axis in "xyzw"]).as_matrix()
    matrix[:3, 3] = [place[axis] for axis in "xyz"]
    return matrix


def odometry(messages):
    poses = [one.message["pose"]["pose"] for one in messages if one.topic == "/odom"]
    times = [1e-9 * (one.stamp - 10**18) for one in messages if one.topic == "/odom"]
    return np.array(times), np.stack([pose(one["position"], one["orientation"]) for one in poses])


def test_the_mounting_is_a_rotation():
    assert np.linalg.det(BASE_FROM_CAMERA[:3, :3]) == pytest.approx(1.0)


def test_exact_odometry_and_mounting_give_the_cameras_path():
    walk, messages = told(EXACT)
    assert messages[0].topic == "/tf_static"
    assert [one.stamp for one in messages] == sorted(one.stamp for one in messages)
    mount = messages[0].message["transforms"][0]["transform"]
    times, poses = odometry(messages)
    assert poses[0, :3, 3] == pytest.approx(np.zeros(3), abs=1e-9)
    assert poses[0, 1, 0] == pytest.approx(0.0, abs=1e-9)  # the odometry's x is where the robot heads
    cameras = poses @ pose(mount["translation"], mount["rotation"])
    true = walk.poses(times)
    step = np.linalg.inv(cameras[0]) @ cameras
    assert step == pytest.approx(np.linalg.inv(true[0]) @ true, abs=1e-9)
    _, stretched = odometry(told(Robot(scale_error=0.02, odometry_noise=0.0))[1])
    assert stretched[:, :3, 3] == pytest.approx(1.02 * poses[:, :3, 3], abs=1e-9)


def test_the_imu_feels_gravity_and_the_walk():
    walk, messages = told(EXACT)
    felt = [one for one in messages if one.topic == "/imu"]
    times = np.array([1e-9 * (one.stamp - 10**18) for one in felt])
    forces = np.array([[one.message["linear_acceleration"][axis] for axis in "xyz"] for one in felt])
    world = np.einsum("nij,nj->ni", (walk.poses(times) @ np.linalg.inv(BASE_FROM_CAMERA))[:, :3, :3], forces)
    # Twice integrated, what is not gravity is the way that was walked.
    speed = (walk.poses([1e-3]) - walk.poses([0.0]))[0, :3, 3] / 1e-3
    speeds = speed + np.cumsum(world - [0, 0, GRAVITY], axis=0) * 0.01
    walked = walk.poses(times)[-1, :3, 3] - walk.poses([0.0])[0, :3, 3]
    assert speeds[:-1].sum(0) * 0.01 == pytest.approx(walked, abs=0.05)
