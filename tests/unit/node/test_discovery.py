# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.node import Node
from std_msgs.msg import Empty

from pipeprog_node.discovery import publishers, subscribers

TIMEOUT = 20.0  # s, for the discovery of a node in the same process, which takes milliseconds on an idle machine


@pytest.fixture
def make_node() -> Iterator[Callable[..., Node]]:
    rclpy.init()
    nodes: list[Node] = []

    def make(name: str, namespace: str = "/") -> Node:
        nodes.append(Node(name, namespace=namespace))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def test_nodes_are_distinguished_by_name_and_namespace(make_node: Callable[..., Node]) -> None:
    frames = make_node("frames")
    for name, namespace in (("rviz", "/"), ("sfm", "/other_robot"), ("sfm", "/")):
        node = make_node(name, namespace)
        node.create_subscription(Empty, "/topic", lambda _: None, 1)
        node.create_publisher(Empty, "/answer", 1)
    wait_for(lambda: frames.count_subscribers("/topic") == frames.count_publishers("/answer") == 3)
    wait_for(lambda: subscribers(frames, "topic") == {"rviz", "sfm"})
    wait_for(lambda: publishers(frames, "answer") == {"rviz", "sfm"})


def test_a_viewer_is_not_taken_for_the_node_that_is_missing(make_node: Callable[..., Node]) -> None:
    frames, viewer = make_node("frames"), make_node("rviz")
    for _ in range(2):  # a viewer with two displays of one topic
        viewer.create_subscription(Empty, "keyframes", lambda _: None, 1)
    wait_for(lambda: frames.count_subscribers("keyframes") == 2)
    wait_for(lambda: subscribers(frames, "keyframes") == {"rviz"})
    make_node("sfm").create_subscription(Empty, "keyframes", lambda _: None, 1)
    wait_for(lambda: subscribers(frames, "keyframes") == {"rviz", "sfm"})
