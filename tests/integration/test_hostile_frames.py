# SPDX-License-Identifier: Apache-2.0
"""The selector's node under attack over real DDS: it goes on, and its keyframes are those of a node left in peace."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_bringup.recording.bag import Bag, ImageMessage
from pipeprog_msgs.msg import FrameDecision, ImageOverlapArray
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from tests.fuzz.fuzzed_messages import fuzzed_messages

BAG = Path(__file__).parents[2] / "bags" / "demo.mcap"
TOPICS = {"camera_info": CameraInfo, "image/compressed": CompressedImage, "image": Image}
ATTACKED = {**TOPICS, "image_overlap": ImageOverlapArray}
ATTACKS = 250  # messages on each topic; an attack of many thousands is `make fuzz`
GOOD = 25  # frames of the recording, of which the selector takes every third or so
IN_FLIGHT = 10  # frames sent and not decided on
TIMEOUT = 60.0  # s, for whatever takes a second on an idle machine


class Selector:
    """One frames node in a namespace of its own, and what it says."""

    def __init__(self, world: Node, namespace: str) -> None:
        reliable = [
            word
            for topic in TOPICS
            for word in ("-p", f"qos_overrides./{namespace}/{topic}.subscription.reliability:=reliable")
        ]
        arguments = ["--ros-args", "-r", f"__ns:=/{namespace}", *reliable]
        self.process = subprocess.Popen([sys.executable, "-m", "pipeprog_frames.node", *arguments])
        self.decisions: dict[int, bool] = {}
        self.keyframes: list[int] = []
        self.health: list[DiagnosticStatus] = []
        self._name = f"{namespace}/frames"
        self.publishers = {
            topic: world.create_publisher(kind, f"/{namespace}/{topic}", qos.reliable(50))
            for topic, kind in ATTACKED.items()
        }
        world.create_subscription(FrameDecision, f"/{namespace}/frame_decisions", self._on_decision, qos.reliable(1000))
        world.create_subscription(
            CompressedImage, f"/{namespace}/keyframes/image/compressed", self._on_keyframe, qos.reliable(50)
        )
        world.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.finish = world.create_client(Finish, f"/{namespace}/frames/finish")
        self._world, self._namespace = world, namespace

    def is_connected(self) -> bool:
        assert self.process.poll() is None, "the node has ended"
        listening = all(publisher.get_subscription_count() for publisher in self.publishers.values())
        heard = self._world.count_publishers(f"/{self._namespace}/keyframes/image/compressed")
        return listening and bool(heard) and self.finish.service_is_ready()

    def chosen(self, stamps: set[int]) -> list[int]:
        """Those that were decided to be keyframes."""
        return sorted(stamp for stamp in stamps if self.decisions.get(stamp))

    def values(self, index: int) -> dict[str, int]:
        return {pair.key: int(pair.value) for pair in self.health[index].values}

    def _on_decision(self, message: FrameDecision) -> None:
        self.decisions[messages.stamp_ns(message.header.stamp)] = message.chosen

    def _on_keyframe(self, message: CompressedImage) -> None:
        """Answers as an SfM does that keeps up; the attack may have told of one that does not."""
        self.keyframes.append(messages.stamp_ns(message.header.stamp))
        answer = ImageOverlapArray(header=message.header, keyframes_considered=len(self.keyframes))
        self.publishers["image_overlap"].publish(answer)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._name):
                self.health.append(status)


class World:
    """Publishes good images and hostile messages to selectors."""

    def __init__(self) -> None:
        self.node = Node("world")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def spin_until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.02)

    def attack(self, selector: Selector, seed: int) -> None:
        """Messages of all topics in turn; those that the node is too slow for, the middleware drops."""
        attacks = {topic: fuzzed_messages(topic, ATTACKS, seed) for topic in ATTACKED}
        for index in range(ATTACKS):
            for topic, publisher in selector.publishers.items():
                publisher.publish(attacks[topic][index].content)
                self._executor.spin_once(timeout_sec=0.0)
        for publisher in selector.publishers.values():
            assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
        selector.health.clear()
        # Until it is over: two diagnostics in a row that count the same.
        self.spin_until(lambda: len(selector.health) > 1 and selector.values(-1) == selector.values(-2))

    def walk(self, selectors: Sequence[Selector], frames: Sequence[ImageMessage]) -> None:
        """The frames of a recording, no further ahead than a replay sends them."""
        for number, frame in enumerate(frames):
            info = deserialize_message(frame.camera_info, CameraInfo)
            info.header = messages.header(frame.stamp, frame.frame_id)
            for selector in selectors:
                selector.publishers["camera_info"].publish(info)
                selector.publishers["image/compressed"].publish(frame.data)
            sent = [each.stamp for each in frames[: number + 1]]
            self.spin_until(partial(_is_near, selectors, sent))


def _is_near(selectors: Sequence[Selector], sent: Sequence[int]) -> bool:
    return all(sum(stamp not in one.decisions for stamp in sent) < IN_FLIGHT for one in selectors)


@pytest.fixture
def world() -> Iterator[World]:
    rclpy.init()
    one = World()
    yield one
    one.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def selectors(world: World) -> Iterator[list[Selector]]:
    started = [Selector(world.node, "attacked"), Selector(world.node, "calm")]
    yield started
    for selector in started:
        selector.process.kill()
        selector.process.wait()


def test_after_an_attack_keyframes_are_chosen_as_without(world: World, selectors: list[Selector]) -> None:
    attacked, calm = selectors
    world.spin_until(lambda: all(selector.is_connected() for selector in selectors))
    world.attack(attacked, seed=16)
    frames = list(Bag.open(BAG))[:GOOD]
    world.walk(selectors, frames)
    # No frame comes after these: what is undecided is the same in both.
    stamps = {frame.stamp for frame in frames}
    world.spin_until(lambda: attacked.chosen(stamps) == calm.chosen(stamps) == sorted(calm.keyframes))
    world.spin_until(lambda: sorted(stamps & set(attacked.keyframes)) == sorted(calm.keyframes))
    assert len(calm.keyframes) >= 5

    absurd = attacked.finish.call_async(Finish.Request(expected_inputs=2**32 - 1))
    second = attacked.finish.call_async(Finish.Request(expected_inputs=GOOD))
    world.spin_until(second.done)
    assert not second.result().success
    assert "another request is pending" in second.result().message
    assert not absurd.done()
    for selector in selectors:
        selector.health.clear()  # the diagnostics of a second ago may be older than the walk
    world.spin_until(lambda: all(selector.health for selector in selectors))
    refused = {key for key in attacked.values(-1) if key.startswith("dropped on ")}
    assert {key.split(":")[0].removeprefix("dropped on ") for key in refused} == set(ATTACKED)
    assert attacked.health[-1].level == DiagnosticStatus.WARN
    assert calm.health[-1].level == DiagnosticStatus.OK
    assert all(selector.process.poll() is None for selector in selectors)
