# SPDX-License-Identifier: Apache-2.0
"""Keyframes for a node that takes a survey up: those published before it came, less those that it knows."""

from __future__ import annotations

import time

import cv2
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage

from pipeprog_camera.camera import Camera
from pipeprog_node import messages, qos
from pipeprog_node.intake import Intake
from pipeprog_node.keyframe_input import CALIBRATIONS, DEPTH, IMAGES, KeyframeInput

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
JPEG = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
START = 1_700_000_000_000_000_000  # ns
TIMEOUT = 60.0  # s, for what takes a tenth on an idle machine


def test_what_was_published_before_comes_and_what_is_known_is_passed_over() -> None:
    rclpy.init()
    selector, taker = Node("selector"), Node("taker")
    executor = SingleThreadedExecutor()
    for node in (selector, taker):
        executor.add_node(node)
    images = selector.create_publisher(CompressedImage, IMAGES, qos.kept(DEPTH))
    infos = selector.create_publisher(CameraInfo, CALIBRATIONS, qos.kept(DEPTH))

    def publish(number: int) -> None:
        images.publish(messages.compressed_image(START + number, "camera", JPEG))
        infos.publish(messages.info_from_camera(CAMERA, START + number, "camera"))

    for number in range(4):
        publish(number)
    used: list[int] = []
    intake = Intake(taker)
    KeyframeInput(intake, lambda stamp, *_: used.append(stamp - START), known=[START, START + 2])
    for number in (1, 3, 4):  # again, by a selector that has taken the survey up itself, and one that is new
        publish(number)
    deadline = time.monotonic() + TIMEOUT
    while 4 not in used:
        assert time.monotonic() < deadline, "waited in vain"
        executor.spin_once(timeout_sec=0.02)
    assert (used, intake.rejected) == ([1, 3, 4], 0)
    executor.shutdown()
    for node in (selector, taker):
        node.destroy_node()
    rclpy.shutdown()
