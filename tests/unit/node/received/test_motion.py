# SPDX-License-Identifier: Apache-2.0
"""Messages of a robot's motion: what is taken of them, and under which kind one is dropped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.limits import MAX_COORDINATE, MAX_NAME, MAX_QUATERNION_ERROR, MAX_SECONDS
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received import header as received_header
from pipeprog_node.received import motion as received_motion

TURN = math.sqrt(0.5)


def odometry(
    position: tuple[float, float, float] = (1.0, 2.0, 3.0),
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, TURN, TURN),
    parent: str = "odom",
    child: str = "base",
    stamp: tuple[int, int] = (5, 7),
) -> Odometry:
    message = Odometry(header=Header(stamp=Time(sec=stamp[0], nanosec=stamp[1]), frame_id=parent), child_frame_id=child)
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = position
    pose.orientation = Quaternion(**dict(zip("xyzw", quaternion, strict=True)))
    return message


def edge(child: str, quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id="/base"), child_frame_id=child)
    message.transform.rotation = Quaternion(**dict(zip("xyzw", quaternion, strict=True)))
    return message


def imu(force: tuple[float, float, float], covariance: float = 0.1, frame: str = "/imu") -> Imu:
    message = Imu(header=Header(frame_id=frame), linear_acceleration=Vector3(**dict(zip("xyz", force, strict=True))))
    message.linear_acceleration_covariance[0] = covariance
    return message


def test_odometry_is_a_transform_between_two_frames() -> None:
    taken = received_motion.odometry(odometry(parent="/odom"))
    assert (taken.stamp, taken.parent, taken.child) == (5_000_000_007, "odom", "base")
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert np.allclose(taken.parent_from_child, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "rotation"),
        ({"quaternion": (1e-200, 0.0, 0.0, 0.0)}, "rotation"),
        ({"quaternion": (0.0, 0.0, 0.0, 1e-300)}, "rotation"),
        ({"quaternion": (0.0, 0.0, 0.0, 1e300)}, "rotation"),
        ({"quaternion": (math.nan, 0.0, 0.0, 1.0)}, "rotation"),
        ({"quaternion": (math.inf, 0.0, 0.0, 1.0)}, "rotation"),
        ({"quaternion": (0.0, 0.0, 0.0, 1.0 + 2 * MAX_QUATERNION_ERROR)}, "rotation"),
        ({"position": (math.nan, 0.0, 0.0)}, "position"),
        ({"position": (0.0, -math.inf, 0.0)}, "position"),
        ({"position": (0.0, 0.0, MAX_COORDINATE)}, "position"),
        ({"parent": ""}, "name"),
        ({"parent": "/"}, "name"),
        ({"child": ""}, "name"),
        ({"child": "/odom"}, "name"),
        ({"parent": "o" * (MAX_NAME + 1)}, "name"),
        ({"child": "b" * (MAX_NAME + 1)}, "name"),
        ({"stamp": (-1, 0)}, "stamp"),
        ({"stamp": (MAX_SECONDS, 0)}, "stamp"),
        ({"stamp": (0, 1_000_000_000)}, "stamp"),
    ],
)
def test_odometry_that_is_no_motion_is_refused(changes: dict[str, Any], kind: str) -> None:
    with pytest.raises(InvalidMessageError) as caught:
        received_motion.odometry(odometry(**changes))
    assert caught.value.kind == kind
    assert len(str(caught.value)) < 4 * MAX_NAME


def test_a_quaternion_typed_with_two_decimals_is_a_rotation() -> None:
    pose = received_motion.odometry(odometry(quaternion=(0.0, 0.71, 0.0, 0.71))).parent_from_child
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_the_last_stamp_taken_leaves_room_for_a_nanosecond() -> None:
    last = received_header.checked_stamp(Time(sec=MAX_SECONDS - 1, nanosec=999_999_999))
    Time(sec=(last + 1) // 10**9, nanosec=(last + 1) % 10**9)


def test_a_bad_transform_does_not_drop_the_others() -> None:
    taken = received_motion.transforms(
        TFMessage(transforms=[edge("one"), edge("two", (0.0, 0.0, 0.0, 0.0)), edge("three")])
    )
    assert [each.child for each in taken.transforms] == ["one", "three"]
    assert [error.kind for error in taken.refused] == ["rotation"]


def test_too_many_transforms_in_one_message_are_refused() -> None:
    with pytest.raises(InvalidMessageError, match="1001 transforms"):
        received_motion.transforms(TFMessage(transforms=[edge("one")] * 1001))


def test_an_imu_tells_what_it_feels() -> None:
    taken = received_motion.imu(imu((0.0, 0.0, 9.8)))
    assert taken.frame == "imu"
    assert taken.force is not None
    assert taken.force.tolist() == [0.0, 0.0, 9.8]
    assert received_motion.imu(imu((0.0, 0.0, 0.0), covariance=-1.0)).force is None


@pytest.mark.parametrize("force", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, 1e300)])
def test_an_acceleration_that_no_robot_feels_is_refused(force: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidMessageError, match="acceleration"):
        received_motion.imu(imu(force))
