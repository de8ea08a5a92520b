# SPDX-License-Identifier: Apache-2.0
"""What the door of a node lets through."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile

from pipeprog_camera.errors import InputError
from pipeprog_node.intake import Intake, InvalidMessageError


class FakeNode:
    """Keeps the callbacks and what is logged."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.losses: dict[str, Callable[[Any], None]] = {}
        self.logged: list[str] = []

    def create_subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        *_: Any,
        event_callbacks: SubscriptionEventCallbacks,
        **__: Any,
    ) -> None:
        self.callbacks[topic] = callback
        self.losses[topic] = event_callbacks.message_lost

    def get_logger(self) -> FakeNode:
        return self

    def error(self, text: str) -> None:
        self.logged.append(text)

    def resolve_topic_name(self, topic: str) -> str:
        return f"/site/{topic}"


def positive(value: int) -> float:
    if value == 0:
        raise InputError("zero")
    if value < 0:
        raise InvalidMessageError("sign", f"{value} is negative")
    return float(value)


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


def test_only_what_can_be_converted_is_used(node: FakeNode) -> None:
    used: list[float] = []
    intake = Intake(node)
    intake.subscribe(int, "numbers", positive, used.append, QoSProfile(depth=1))
    for value in (1, -2, 3, 0, -4):
        node.callbacks["numbers"](value)
    assert used == [1.0, 3.0]
    assert intake.rejected == 3
    assert intake.health() == {"dropped on numbers: invalid": 1, "dropped on numbers: sign": 2}


def test_who_waits_for_a_message_is_told_that_it_was_dropped(node: FakeNode) -> None:
    used: list[float] = []
    dropped: list[int] = []
    Intake(node).subscribe(int, "numbers", positive, used.append, QoSProfile(depth=1), dropped=dropped.append)
    for value in (1, -2, 0):
        node.callbacks["numbers"](value)
    assert (used, dropped) == ([1.0], [-2, 0])


def test_each_kind_is_said_once(node: FakeNode) -> None:
    intake = Intake(node)
    intake.subscribe(int, "numbers", positive, lambda value: None, QoSProfile(depth=1))
    for value in (-2, -4, -2, 0, 0):
        node.callbacks["numbers"](value)
    assert [line.partition(";")[0] for line in node.logged] == [
        "dropped a message on /site/numbers: -2 is negative",
        "dropped a message on /site/numbers: zero",
    ]


def test_what_the_network_loses_is_counted_by_topic(node: FakeNode) -> None:
    intake = Intake(node)
    for topic in ("numbers", "others"):
        intake.subscribe(int, topic, positive, lambda _: None, QoSProfile(depth=1))
    for total, change in ((2, 2), (5, 3)):
        node.losses["numbers"](SimpleNamespace(total_count=total, total_count_change=change))
    assert intake.lost == 5
    assert intake.health() == {"lost on the way to numbers": 5}
