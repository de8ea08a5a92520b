# SPDX-License-Identifier: Apache-2.0
"""A robot that walks as a recording has it: its drivers' topics, in real time, whether they are received or not."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from pipeprog_bringup.playback.player import IMAGE_TYPES, MAX_GAP, MOTION_TYPES, motion_content
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.recording.frame_check import ImageMessage
from pipeprog_bringup.recording.topic_choice import TF_STATIC
from pipeprog_node import messages, qos

_IMAGES = 10  # that a driver keeps for a slow reader
_MOTION = 100  # messages of odometry and IMU: two seconds of a robot's
_STATIC = 10  # of /tf_static, which stay for those who come late


def camera_names(count: int) -> list[str]:
    """What the topics of a robot's cameras begin with; none for a single one, whose topics have the graph's names."""
    return [f"camera{number}" for number in range(count)] if count > 1 else []


class SimulatedRobot:
    """Publishes what recordings of the same cameras hold."""

    def __init__(self, node: Node, bag: Bag) -> None:
        """The topics of the cameras and motion that `bag` has; it stands still until it is let walk."""
        image_type, image_topic = IMAGE_TYPES[bag.image_type]
        self._cameras = [
            (
                node.create_publisher(image_type, f"{prefix}{image_topic}", qos.sensor(_IMAGES)),
                node.create_publisher(CameraInfo, f"{prefix}camera_info", qos.sensor(_IMAGES)),
            )
            for prefix in [f"{name}/" for name in camera_names(len(bag.rig))] or [""]
        ]
        self._motion = {
            topic: node.create_publisher(kind, topic, qos.kept(_STATIC) if topic == TF_STATIC else qos.sensor(_MOTION))
            for topic, kind in MOTION_TYPES.items()
        }

    def walk(self, bag: Bag, rate: float, pause: Callable[[float], bool]) -> None:
        """Sends a recording at `rate` times real time; damaged messages are left out.

        `pause(due)` waits until the time `due` of time.monotonic; it returns False where the walk is to end.
        """
        numbers = {camera.frame_id: number for number, camera in enumerate(bag.rig)}
        due, previous = time.monotonic(), None
        for message in bag.with_motion():
            if isinstance(message, MotionMessage):
                self._send_motion(message)
            elif not message.fault:
                gap = 0 if previous is None else message.stamp - previous
                due += min(max(gap * 1e-9, 0.0), MAX_GAP) / rate
                previous = message.stamp
                if not pause(due):
                    return
                self._send_image(message, numbers.get(message.frame_id, 0))

    def _send_image(self, message: ImageMessage, number: int) -> None:
        images, infos = self._cameras[number]
        stamp = message.stamp - number  # as its driver has it: the recording's reader tells cameras apart by stamps
        info = deserialize_message(message.camera_info, CameraInfo)
        info.header = messages.header(stamp, message.frame_id)
        infos.publish(info)
        images.publish(cdr.with_stamp(message.data, stamp))

    def _send_motion(self, message: MotionMessage) -> None:
        content = motion_content(message)
        if content is not None:
            self._motion[message.topic].publish(content)
