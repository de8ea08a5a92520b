# SPDX-License-Identifier: Apache-2.0
"""How a survey ends: one request at a time, and none that waits for ever."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future

from pipeprog_msgs.srv import Finish
from pipeprog_node import finish


class Stage:
    """A node that offers the service, and its caller, in this process."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = Node("stage")
        self.received = self.begun = self.looked = 0  # looked: times that the service has asked what has come
        self.service = finish.FinishService(self.node, self._look, self._begin)
        self._client = self.node.create_client(Finish, "~/finish")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.spin_until(self._client.service_is_ready)

    def _begin(self) -> None:
        self.begun += 1

    def _look(self) -> int:
        self.looked += 1
        return self.received

    def call(self, expected: int) -> Future:
        return self._client.call_async(Finish.Request(expected_inputs=expected))

    def spin_until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.02)


@pytest.fixture
def stage() -> Iterator[Stage]:
    one = Stage()
    yield one
    one.node.destroy_node()
    rclpy.shutdown()


def test_a_second_request_for_other_inputs_is_refused_while_one_is_pending(stage: Stage) -> None:
    first = stage.call(3)
    stage.spin_until(lambda: stage.service.expected == 3)
    again = stage.call(3)  # of a client that has taken the place of the first
    second = stage.call(7)
    stage.spin_until(second.done)
    assert not second.result().success
    assert "for 3 inputs of which 0 have come" in second.result().message
    assert stage.begun == 1
    assert not stage.service.is_due
    stage.received = 3
    assert stage.service.is_due
    stage.service.answer(5)
    for same in (first, again):
        stage.spin_until(same.done)
        assert (same.result().success, same.result().outputs) == (True, 5)
    assert stage.service.expected is None
    third = stage.call(1)
    stage.spin_until(lambda: stage.service.is_due)
    stage.service.answer(0, "no image could be used")
    stage.spin_until(third.done)
    assert (third.result().success, third.result().message) == (False, "no image could be used")


def test_a_request_for_other_inputs_has_its_turn_after_one_whose_inputs_have_come(stage: Stage) -> None:
    first = stage.call(3)  # of a client that died while the node works
    stage.spin_until(lambda: stage.service.expected == 3)
    stage.received, stage.looked = 3, 0
    second = stage.call(4)
    stage.spin_until(lambda: stage.looked)  # it has come
    stage.service.answer(1)
    stage.spin_until(lambda: stage.service.expected == 4)
    stage.received = 4
    stage.service.answer(2)
    for asked, outputs in ((first, 1), (second, 2)):
        stage.spin_until(asked.done)
        assert (asked.result().success, asked.result().outputs) == (True, outputs)
    assert stage.begun == 2


def test_inputs_that_never_come_are_not_waited_for(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finish, "PATIENCE", 1.0)
    absurd = stage.call(2**32 - 1)
    stage.spin_until(absurd.done)
    assert not absurd.result().success
    assert "0 of 4294967295 expected inputs have come" in absurd.result().message
    assert stage.service.expected is None
