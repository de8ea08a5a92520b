# SPDX-License-Identifier: Apache-2.0
"""Sends a recording into the graph: its images with their calibration, and the motion between them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from tf2_msgs.msg import TFMessage

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.recording.frame_check import ImageMessage
from pipeprog_bringup.recording.topic_choice import TF, TF_STATIC
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_SMALL_MESSAGE
from pipeprog_node import messages, qos

# Frames of a camera sent and not decided on, at most; more than frames.window (6 at most) and the frames that are held
# until the next ones confirm their stamps (2) together, or the selector would wait.
IN_FLIGHT = 10
KEPT = 1000  # messages of motion, ten times what is ever on its way (MOTION_IN_FLIGHT)
MAX_GAP = 60.0  # s of the recording between two frames that a rate is held for; a stamp may be years off
MOTION_IN_FLIGHT = 100  # messages of motion between two waits for the SfM to have them
IMAGE_TYPES = {cdr.COMPRESSED_IMAGE: (CompressedImage, "image/compressed"), cdr.IMAGE: (Image, "image")}
MOTION_TYPES = {"odometry": Odometry, "imu": Imu, TF: TFMessage, TF_STATIC: TFMessage}


class Player:
    """Publishes what `bag` holds; `log` is told of each frame that is sent."""

    def __init__(self, node: Node, bag: Bag, log: FrameLog) -> None:
        self._bag, self._log = bag, log
        self.motion_sent = 0  # messages; one of TF counts for each of its transforms, as in SfmStatus
        image_type, image_topic = IMAGE_TYPES[bag.image_type]
        self._in_flight = IN_FLIGHT * max(len(bag.rig), 1)
        self._images = node.create_publisher(image_type, image_topic, qos.reliable(4 * self._in_flight))
        self._infos = node.create_publisher(CameraInfo, "camera_info", qos.reliable(4 * self._in_flight))
        self._motion = {
            topic: node.create_publisher(kind, topic, qos.kept(KEPT) if topic == TF_STATIC else qos.reliable(KEPT))
            for topic, kind in MOTION_TYPES.items()
            if topic in bag.motion_topics.values()
        }
        self.image_topics = [image_topic, "camera_info"]
        self.motion_topics = list(self._motion)

    def play(self, rate: float | None, spin: Callable[[float], None], pause: Callable[[float], None]) -> int:
        """Send every frame, at most IN_FLIGHT of each camera ahead of the selector; returns the number sent.

        With `rate` at that multiple of real time, with None as fast as the nodes take the frames. `spin(seconds)`
        handles what the nodes answer, `pause(due)` does so until the time `due` of time.monotonic. Raises InputError
        where all images are damaged.
        """
        played = 0
        due, previous = time.monotonic(), None
        for message in self._bag.with_motion():
            if isinstance(message, MotionMessage):
                self._send_motion(message)
                continue
            if message.fault:
                self._log.skip(message.stamp, message.fault)
                continue
            while self._log.in_flight >= self._in_flight:
                spin(0.1)
            if rate is not None:
                gap = 0 if previous is None else message.stamp - previous
                due += min(max(gap * 1e-9, 0.0), MAX_GAP) / rate
                pause(due)
            previous = message.stamp
            self._send_image(message)
            played += 1
        if not played:
            raise InputError(f"{self._bag.path}: all {self._bag.image_count} images are damaged")
        return played

    def _send_image(self, message: ImageMessage) -> None:
        self._log.play(message.stamp)
        self._infos.publish(calibration(message))
        self._images.publish(message.data)

    def _send_motion(self, message: MotionMessage) -> None:
        """Pass a message of motion on; a damaged one is left out."""
        content = motion_content(message)
        if content is None:
            self._log.skip_motion(message.topic)
            return
        publisher = self._motion[message.topic]
        publisher.publish(content)
        self.motion_sent += len(content.transforms) if isinstance(content, TFMessage) else 1
        if self.motion_sent % MOTION_IN_FLIGHT == 0:
            publisher.wait_for_all_acked()


def calibration(message: ImageMessage) -> CameraInfo:
    """The calibration in force, under the stamp of its image, as image_transport would pair them."""
    info = deserialize_message(message.camera_info, CameraInfo)
    info.header = messages.header(message.stamp, message.frame_id)
    return info


def motion_content(message: MotionMessage) -> Any:
    """A message of motion, decoded; None where it is damaged."""
    if len(message.data) > MAX_SMALL_MESSAGE:  # what it claims to hold would be allocated first
        return None
    try:
        return deserialize_message(message.data, MOTION_TYPES[message.topic])
    except Exception:  # rclpy raises whatever its type support makes of the bytes
        return None
