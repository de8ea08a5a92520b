# SPDX-License-Identifier: Apache-2.0
"""The camera on /tf, and that its own transforms do not come back as motion."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from pipeprog_node import messages
from pipeprog_node.camera_transforms import CameraTransforms
from pipeprog_node.intake import Intake
from pipeprog_node.received import motion as received_motion
from pipeprog_sfm.node import MotionInput
from tests.unit.sfm.test_node import Topics


class Published:
    """Stands for a node; keeps what is published."""

    def __init__(self) -> None:
        self.sent: list[TFMessage] = []

    def create_publisher(self, *_: Any) -> Published:
        return self

    def publish(self, message: TFMessage) -> None:
        self.sent.append(message)


def trajectory(*stamps: int) -> tuple[np.ndarray, np.ndarray]:
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", (0.1, -0.7, 2.0)).as_matrix()
    poses[:, 0, 3] = stamps
    return np.array(stamps), poses


def test_the_newest_keyframe_is_published_once() -> None:
    node = Published()
    output = CameraTransforms(node)
    for stamps in ((1,), (1, 2), (1, 2), (1,)):
        output.publish(*trajectory(*stamps), "camera")
    assert [messages.stamp_ns(sent.transforms[0].header.stamp) for sent in node.sent] == [1, 2]
    (read,) = received_motion.transforms(node.sent[-1]).transforms
    assert (read.parent, read.child) == ("map", "camera")
    np.testing.assert_allclose(read.parent_from_child, trajectory(2)[1][0], atol=1e-12)


def test_its_own_transforms_are_no_motion_of_the_robot() -> None:
    own = messages.transform(5, "map", "camera", np.eye(4))
    for ignored, expected in ((None, ["camera", "base"]), ("map", ["base"])):
        topics = Topics()
        motion = MotionInput(Intake(topics), True, ignored)
        topics.send("/tf", TFMessage(transforms=[own, messages.transform(6, "odom", "base", np.eye(4))]))
        assert [edge.child for edge in motion.take().transforms] == expected
