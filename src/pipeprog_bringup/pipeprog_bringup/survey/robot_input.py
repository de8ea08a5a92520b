# SPDX-License-Identifier: Apache-2.0
"""What the robot sends during a survey, kept as a recording that a replay takes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from tf2_msgs.msg import TFMessage

from pipeprog_bringup.survey.survey_output import SurveyOutput
from pipeprog_node import qos

_CAMERA = {"image/compressed": CompressedImage, "image": Image, "camera_info": CameraInfo}
_RIG = {"compressed": CompressedImage} | _CAMERA  # as frames has them
_MOTION = {
    "odometry": Odometry,
    "imu": Imu,
    "/tf": TFMessage,
}
_DEPTH = 1000  # messages of each topic that may wait while a file is written: 1 s of the fastest IMU


class RobotInput:
    """Subscribes to the topics of the graph's input, by the names under which the node has them."""

    def __init__(self, node: Node, output: SurveyOutput, cameras: Sequence[str] = ()) -> None:
        """`cameras`: what the topics of a rig's cameras begin with; none: one camera."""
        self._node = node
        rig = {f"{camera}/{topic}": kind for camera in cameras for topic, kind in _RIG.items()}
        streams = (rig or _CAMERA) | _MOTION
        profiles = {topic: qos.sensor(_DEPTH) for topic in streams} | {"/tf_static": qos.kept(_DEPTH)}
        self._subscriptions = [
            node.create_subscription(kind, topic, partial(self._keep, output, topic, kind), profiles[topic], raw=True)
            for topic, kind in (streams | {"/tf_static": TFMessage}).items()
        ]

    def close(self) -> None:
        """Nothing more is kept."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _keep(self, output: SurveyOutput, topic: str, kind: type, data: bytes) -> None:
        name = self._node.resolve_topic_name(topic)
        output.keep_input(name, kind, data, self._node.get_clock().now().nanoseconds)
