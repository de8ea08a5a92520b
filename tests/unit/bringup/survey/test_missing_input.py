# SPDX-License-Identifier: Apache-2.0
"""What is said where images or odometry do not come: names, QoS, and nothing while all is well."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage

from pipeprog_bringup.survey.missing_input import missing_input, missing_odometry
from pipeprog_node import qos


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node, Node]]:
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    made = Node("survey"), Node("frames"), Node("driver")
    yield made
    for node in made:
        node.destroy_node()
    rclpy.try_shutdown()


def until(told: Callable[[], str], *words: str, seconds: float = 10.0) -> str:
    """What is said, as soon as it has all of the words: nodes find each other in their own time."""
    deadline = time.monotonic() + seconds
    while not all(word in told() for word in words) or (not words and told()):
        assert time.monotonic() < deadline, told()
        time.sleep(0.02)
    return told()


def test_the_nearest_topic_is_named(nodes: tuple[Node, Node, Node]) -> None:
    survey, _, driver = nodes
    until(lambda: missing_input(survey), "nobody publishes /image/compressed or /image,", "driver running")
    driver.create_publisher(CompressedImage, "/cam/image/compressed", 1)
    driver.create_publisher(CompressedImage, "/keyframes/image/compressed", 1)
    until(lambda: missing_input(survey), "nearest topic of that kind is /cam/image/compressed")
    rig = lambda: missing_input(survey, ["/spot/camera/left"])  # noqa: E731
    until(rig, "/spot/camera/left/image/compressed or /spot/camera/left/image or /spot/camera/left/compressed")


def test_all_is_well_once_image_and_calibration_are_received(nodes: tuple[Node, Node, Node]) -> None:
    survey, frames, driver = nodes
    driver.create_publisher(CompressedImage, "image/compressed", qos.sensor(1))
    until(lambda: missing_input(survey), "/image/compressed is published", "image_transport")
    frames.create_subscription(CompressedImage, "image/compressed", lambda _: None, qos.sensor(1))
    until(lambda: missing_input(survey), "nobody publishes /camera_info")
    driver.create_publisher(CameraInfo, "camera_info", qos.sensor(1))
    frames.create_subscription(CameraInfo, "camera_info", lambda _: None, qos.sensor(1))
    until(lambda: missing_input(survey))


def test_qos_that_does_not_fit_is_told_of_both_sides(nodes: tuple[Node, Node, Node]) -> None:
    survey, frames, driver = nodes
    driver.create_publisher(CompressedImage, "image/compressed", qos.sensor(1))
    frames.create_subscription(CompressedImage, "image/compressed", lambda _: None, qos.reliable(1))
    told = until(lambda: missing_input(survey), "driver offers best effort", "frames asks for reliable")
    assert told.startswith("/image/compressed")


def test_the_nearest_topic_of_odometry_is_named(nodes: tuple[Node, Node, Node]) -> None:
    survey, _, driver = nodes
    until(lambda: missing_odometry(survey), "nobody publishes /odometry, nor anything else of", "hang up a board")
    driver.create_publisher(Odometry, "/spot/odometry", 1)
    until(lambda: missing_odometry(survey), "nearest topic of that kind is /spot/odometry: remap it")


def test_all_is_well_once_odometry_is_received(nodes: tuple[Node, Node, Node]) -> None:
    survey, sfm, driver = nodes
    driver.create_publisher(Odometry, "odometry", qos.sensor(1))
    until(lambda: missing_odometry(survey), "/odometry is published", "sfm does not subscribe")
    sfm.create_subscription(Odometry, "odometry", lambda _: None, qos.sensor(1))
    until(lambda: missing_odometry(survey))


def test_qos_of_odometry_that_does_not_fit_is_told_of_both_sides(nodes: tuple[Node, Node, Node]) -> None:
    survey, sfm, driver = nodes
    driver.create_publisher(Odometry, "odometry", qos.sensor(1))
    sfm.create_subscription(Odometry, "odometry", lambda _: None, qos.reliable(1))
    told = until(lambda: missing_odometry(survey), "driver offers best effort", "asks for reliable")
    assert told.startswith("/odometry")
