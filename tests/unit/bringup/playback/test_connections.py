# SPDX-License-Identifier: Apache-2.0
"""Which connections are missing, over real DDS, with and without viewers that subscribe to the same topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.node import Node
from std_msgs.msg import Empty

from pipeprog_bringup.playback.connections import LISTENER, PUBLISHERS, SUBSCRIBERS, missing_connections

TIMEOUT = 20.0  # s, for the discovery of a node in the same process, which takes milliseconds on an idle machine
IMAGES, MOTION = ["image/compressed", "camera_info"], ["odometry"]
TOPICS = [*SUBSCRIBERS, *IMAGES, *MOTION]


class Graph:
    """Nodes that subscribe and publish as the graph's do; the types of the messages play no part."""

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self.add("replay")

    def add(self, name: str, topics: list[str] | None = None) -> None:
        node = self.nodes[name] = Node(name)
        own = [
            topic for topic, names in SUBSCRIBERS.items() if name in names or (name == "replay" and LISTENER in names)
        ]
        own += {"frames": IMAGES, "sfm": MOTION}.get(name, [])
        for topic in own if topics is None else topics:
            node.create_subscription(Empty, topic, lambda _: None, 1)
        for topic, publisher in PUBLISHERS.items():
            if publisher == name:
                node.create_publisher(Empty, topic, 1)

    def missing(self) -> list[str]:
        return missing_connections(self.nodes["replay"], IMAGES, MOTION)

    def wait_for(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain: {self.missing()}"
            time.sleep(0.01)


@pytest.fixture
def graph() -> Iterator[Graph]:
    rclpy.init()
    graph = Graph()
    yield graph
    for node in graph.nodes.values():
        node.destroy_node()
    rclpy.shutdown()


def test_viewers_that_subscribe_are_not_mistaken_for_nodes(graph: Graph) -> None:
    """Three viewers on every topic: by count, all nodes would seem to be there."""
    graph.add("frames")
    for viewer in ("rviz", "foxglove_bridge", "rosbag2_recorder"):
        graph.add(viewer, TOPICS)
    replay = graph.nodes["replay"]
    graph.wait_for(lambda: all(replay.count_subscribers(topic) >= 3 for topic in TOPICS))
    without_sfm_and_detect = [
        f"{name} does not subscribe to {topic}"
        for topic, names in SUBSCRIBERS.items()
        for name in sorted(names & {"sfm", "detect"})
    ]
    without_sfm_and_detect += ["sfm does not subscribe to odometry"]
    without_sfm_and_detect += [
        f"{name} does not publish {topic}" for topic, name in PUBLISHERS.items() if name in ("sfm", "detect")
    ]
    graph.wait_for(lambda: graph.missing() == without_sfm_and_detect)
    graph.add("sfm")
    graph.add("detect")
    graph.wait_for(lambda: not graph.missing())
