# SPDX-License-Identifier: Apache-2.0
"""The messages of a robot that carries the camera: odometry, IMU, and where the camera is mounted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sitegen.walk import Walk

FloatArray = NDArray[np.float64]

GRAVITY = 9.80665
ODOMETRY_HZ, IMU_HZ = 50.0, 100.0
# The camera on a robot's front, looking to its left, where the walks have their walls: x ahead, y down, z left.
BASE_FROM_CAMERA = np.array([[1.0, 0, 0, 0.30], [0, 0, 1.0, 0.05], [0, -1.0, 0, 0.45], [0, 0, 0, 1.0]])
CAMERA_FRAME = "camera_optical"
# The cameras of a rig as the first one has them: m along the walk (x), and degrees by which they look aside. As on
# Spot, neighbours see the same wall from a hand's breadth apart and from different sides.
_RIG = ((0.0, 0.0), (0.25, -20.0), (-0.25, 20.0), (0.12, 12.0), (-0.12, -12.0))
MAX_RIG = len(_RIG)
# Degrees by which cameras are turned about where they look, in the same order: those of Spot's images are turned so.
_TURNS = (0.0, -102.0, -78.0, 180.0, 0.0)


@dataclass(frozen=True)
class Robot:
    """Errors of its odometry and of its IMU.

    Attributes:
        scale_error: relative error of all lengths that odometry tells.
        odometry_noise: random walk of the position, m per root metre.
        imu_bias: of the accelerometer, m/s^2, in a random direction.
        imu_noise: of each acceleration, m/s^2.
    """

    scale_error: float = 0.0
    odometry_noise: float = 0.01
    imu_bias: float = 0.03
    imu_noise: float = 0.05


@dataclass(frozen=True)
class MountedWalk:
    """The walk of a camera of the robot, mounted at first_from_camera (4, 4)."""

    walk: Walk
    first_from_camera: FloatArray

    def poses(self, seconds: ArrayLike) -> FloatArray:
        """(N, 4, 4) world_from_camera (optical frame) at (N,) times."""
        return self.walk.poses(seconds) @ self.first_from_camera


def mounted(number: int, is_turned: bool = False) -> FloatArray:
    """first_from_camera (4, 4) of the camera of this number, 0 to MAX_RIG - 1; turned: as it is on Spot."""
    along, degrees = _RIG[number]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("YZ", [degrees, _TURNS[number] * is_turned], degrees=True).as_matrix()
    pose[0, 3] = along
    return pose


def camera_frame(number: int) -> str:
    """The optical frame of the camera of this number."""
    return CAMERA_FRAME if number == 0 else f"camera{number}_optical"


@dataclass(frozen=True)
class RobotMessage:
    """One message: topic, type, content as plain values, stamp in ns."""

    topic: str
    type_name: str
    message: dict[str, Any]
    stamp: int


def robot_messages(
    walk: Walk,
    robot: Robot,
    seconds: float,
    first_stamp: int,
    rng: np.random.Generator,
    mounts: Sequence[FloatArray] = (np.eye(4),),
) -> Iterator[RobotMessage]:
    """Messages in order of time: /tf_static, then /odom and /imu from shortly before the first frame on.

    `mounts`: first_from_camera (4, 4) of each camera.
    """
    edges = [
        _transform("base_link", camera_frame(number), BASE_FROM_CAMERA @ mount, first_stamp)
        for number, mount in enumerate(mounts)
    ]
    yield RobotMessage("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": edges}, first_stamp)
    messages = [*_odometry(walk, robot, seconds, first_stamp, rng), *_imu(walk, robot, seconds, first_stamp, rng)]
    yield from sorted(messages, key=lambda message: message.stamp)


def _odometry(
    walk: Walk, robot: Robot, seconds: float, first_stamp: int, rng: np.random.Generator
) -> Iterator[RobotMessage]:
    times = np.arange(0.0, seconds + 1 / ODOMETRY_HZ, 1 / ODOMETRY_HZ)
    poses = walk.poses(times) @ np.linalg.inv(BASE_FROM_CAMERA)
    steps = np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3])
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    steps = (1 + robot.scale_error) * steps + rng.normal(0, robot.odometry_noise, steps.shape) * np.sqrt(length)
    # The odometry's frame is level, as is the world, and lies where the robot has started.
    heading = Rotation.from_euler("z", -np.arctan2(poses[0, 1, 0], poses[0, 0, 0])).as_matrix()
    told = np.tile(np.eye(4), (len(times), 1, 1))
    told[:, :3, :3] = heading @ poses[:, :3, :3]
    told[:, :3, 3] = np.cumsum(steps, axis=0) @ heading.T
    for t, pose in zip(times, told, strict=True):
        stamp = first_stamp + round(float(t) * 1e9)
        place, turn = _parts(pose)
        message = {
            "header": _header(stamp, "odom"),
            "child_frame_id": "base_link",
            "pose": {"pose": {"position": place, "orientation": turn}, "covariance": [0.0] * 36},
            "twist": {"twist": {"linear": _xyz(np.zeros(3)), "angular": _xyz(np.zeros(3))}, "covariance": [0.0] * 36},
        }
        yield RobotMessage("/odom", "nav_msgs/msg/Odometry", message, stamp)


def _imu(
    walk: Walk, robot: Robot, seconds: float, first_stamp: int, rng: np.random.Generator
) -> Iterator[RobotMessage]:
    times = np.arange(0.0, seconds + 1 / IMU_HZ, 1 / IMU_HZ)
    step = 1e-3
    before, here, after = (walk.poses(np.maximum(times + offset, 0.0)) for offset in (-step, 0.0, step))
    acceleration = (after - 2 * here + before)[:, :3, 3] / step**2
    acceleration[times < step] = 0.0
    bias = rng.normal(0, 1, 3)
    bias *= robot.imu_bias / np.linalg.norm(bias)
    felt = acceleration + np.array([0.0, 0.0, GRAVITY])
    force = np.einsum("nji,nj->ni", here[:, :3, :3], felt) @ BASE_FROM_CAMERA[:3, :3].T
    force += bias + rng.normal(0, robot.imu_noise, force.shape)
    for t, value in zip(times, force, strict=True):
        stamp = first_stamp + round(float(t) * 1e9)
        message = {
            "header": _header(stamp, "base_link"),
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "orientation_covariance": [-1.0] + [0.0] * 8,
            "angular_velocity": _xyz(np.zeros(3)),
            "angular_velocity_covariance": [-1.0] + [0.0] * 8,
            "linear_acceleration": _xyz(value),
            "linear_acceleration_covariance": [0.0] * 9,
        }
        yield RobotMessage("/imu", "sensor_msgs/msg/Imu", message, stamp)


def _transform(parent: str, child: str, pose: FloatArray, stamp: int) -> dict[str, Any]:
    place, turn = _parts(pose)
    return {
        "header": _header(stamp, parent),
        "child_frame_id": child,
        "transform": {"translation": place, "rotation": turn},
    }


def _header(stamp: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": frame}


def _parts(pose: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return _xyz(pose[:3, 3]), dict(zip("xyzw", turn.tolist(), strict=True))


def _xyz(vector: FloatArray) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))
