# SPDX-License-Identifier: Apache-2.0
"""Transforms, odometry and accelerations from outside, checked: values in SI units, or InvalidMessageError."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.limits import (
    MAX_ACCELERATION,
    MAX_COORDINATE,
    MAX_NAME,
    MAX_QUATERNION_ERROR,
    MAX_TRANSFORMS,
)
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received.header import stamp_and_frame


@dataclass(frozen=True)
class ReceivedTransform:
    """parent_from_child (4, 4), rigid, between two frames at a time [ns]."""

    stamp: int
    parent: str
    child: str
    parent_from_child: NDArray[np.float64]


@dataclass(frozen=True)
class ReceivedTransforms:
    """The transforms of one TFMessage that can be used, and why others cannot."""

    transforms: tuple[ReceivedTransform, ...]
    refused: tuple[InvalidMessageError, ...]


@dataclass(frozen=True)
class ReceivedAcceleration:
    """Specific force (3,) [m/s^2] in the frame of an IMU at a time [ns]; None where the IMU measures none."""

    stamp: int
    frame: str
    force: NDArray[np.float64] | None


def odometry(message: Odometry) -> ReceivedTransform:
    """The pose of the robot's base; the twist and both covariances are not used."""
    pose = message.pose.pose
    return _transform(message.header, message.child_frame_id, pose.position, pose.orientation)


def transforms(message: TFMessage) -> ReceivedTransforms:
    """Each transform by itself: one that cannot be used does not drop the others."""
    if len(message.transforms) > MAX_TRANSFORMS:
        raise InvalidMessageError(
            "count", f"a TFMessage of {len(message.transforms)} transforms: {MAX_TRANSFORMS} at most are taken"
        )
    usable, refused = [], []
    for each in message.transforms:
        edge = each.transform
        try:
            usable.append(_transform(each.header, each.child_frame_id, edge.translation, edge.rotation))
        except InvalidMessageError as error:
            refused.append(error)
    return ReceivedTransforms(tuple(usable), tuple(refused))


def imu(message: Imu) -> ReceivedAcceleration:
    """The linear acceleration, which is finite and one that a robot can feel."""
    stamp, frame_id = stamp_and_frame(message.header)
    # REP 145: a covariance of -1 says that there are no accelerations.
    if not message.linear_acceleration_covariance[0] >= 0:
        return ReceivedAcceleration(stamp, _frame(frame_id), None)
    force = message.linear_acceleration
    if not all(abs(value) <= MAX_ACCELERATION for value in (force.x, force.y, force.z)):  # false for NaN
        raise InvalidMessageError(
            "acceleration", f"an acceleration of ({force.x:g}, {force.y:g}, {force.z:g}) m/s^2: check the IMU's driver"
        )
    return ReceivedAcceleration(stamp, _frame(frame_id), np.array([force.x, force.y, force.z]))


def rigid_transform(position: Point | Vector3, orientation: Quaternion) -> NDArray[np.float64]:
    """(4, 4) of a position [m] below MAX_COORDINATE and a quaternion whose norm is 1 to MAX_QUATERNION_ERROR."""
    x, y, z = position.x, position.y, position.z
    if not (abs(x) < MAX_COORDINATE and abs(y) < MAX_COORDINATE and abs(z) < MAX_COORDINATE):  # false for NaN
        raise InvalidMessageError("position", f"the position ({x:g}, {y:g}, {z:g}) m is none on Earth")
    quaternion = orientation.x, orientation.y, orientation.z, orientation.w
    if not abs(math.hypot(*quaternion) - 1.0) <= MAX_QUATERNION_ERROR:
        listed = ", ".join(f"{value:g}" for value in quaternion)
        raise InvalidMessageError("rotation", f"the quaternion ({listed}) is no rotation: its norm must be 1")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), (x, y, z)
    return pose


def _transform(
    header: Header, child_frame_id: str, position: Point | Vector3, orientation: Quaternion
) -> ReceivedTransform:
    stamp, frame_id = stamp_and_frame(header)
    parent, child = _frame(frame_id), _frame(child_frame_id)
    if not parent or not child or parent == child or len(child) > MAX_NAME:
        raise InvalidMessageError(
            "name", f"a transform from {parent!r} to {child[:MAX_NAME]!r}: two names of frames are needed"
        )
    return ReceivedTransform(stamp, parent, child, rigid_transform(position, orientation))


def _frame(name: str) -> str:
    """tf2 takes names with and without the leading slash of ROS 1 for the same."""
    return name.lstrip("/")
