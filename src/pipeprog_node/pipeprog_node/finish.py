# SPDX-License-Identifier: Apache-2.0
"""The service `~/finish` of a node, by which a survey ends."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from pipeprog_msgs.srv import Finish

PATIENCE = 60.0  # s without a further input; those that were published before the call arrive within a second
_PERIOD = 1.0  # s


class FinishService:
    """One request at a time: the node is told when it comes, asks whether it is due, and answers it.

    The client of a pending request may have died. A further one gets its answer where it expects as many inputs; else
    it has its turn after that one, if the inputs of that one have come, and is refused at once if they have not. A
    request whose inputs do not come for PATIENCE seconds is refused, too: the number that it expects may be wrong, and
    nobody else could finish the survey.
    """

    def __init__(self, node: Node, received: Callable[[], int], begin: Callable[[], None]) -> None:
        """`received` is the number of inputs that have come so far; `begin` is called once a request is accepted."""
        self._received, self._begin = received, begin
        self._pending: Future | None = None
        self._expected = 0
        self._seen, self._waited = 0, 0.0
        # In a group of its own: while it waits for the end, the other callbacks must run.
        self._service = node.create_service(
            Finish, "~/finish", self._on_request, callback_group=ReentrantCallbackGroup()
        )
        # Steady time: a paused recording stops ROS time.
        self._timer = node.create_timer(_PERIOD, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def expected(self) -> int | None:
        """Inputs that the pending request expects; None: no request is pending."""
        return None if self._pending is None else self._expected

    @property
    def is_due(self) -> bool:
        """Whether a request is pending and its inputs have all come."""
        return self._pending is not None and self._received() >= self._expected

    def answer(self, outputs: int, problem: str = "") -> None:
        """Answers the pending request, if there is one; without a `problem` it has succeeded."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.set_result((outputs, problem))

    async def _on_request(self, request: Finish.Request, response: Finish.Response) -> Finish.Response:
        while (pending := self._pending) is not None and self._is_other(request) and self.is_due:
            await pending
        if self._is_other(request):
            response.message = (
                f"another request is pending, for {self._expected} inputs of which {self._received()} have come: "
                "wait for its answer"
            )
            return response
        done = self._pending
        if done is None:
            done = self._pending = Future()
            self._expected = request.expected_inputs
            self._seen, self._waited = self._received(), 0.0
            self._begin()
        response.outputs, response.message = await done
        response.success = not response.message
        return response

    def _is_other(self, request: Finish.Request) -> bool:
        """Whether a request is pending that expects another number of inputs."""
        return self._pending is not None and request.expected_inputs != self._expected

    def _watch(self) -> None:
        if self._pending is None or self.is_due:
            return
        received = self._received()
        self._waited = self._waited + _PERIOD if received == self._seen else 0.0
        self._seen = received
        if self._waited >= PATIENCE:
            self.answer(
                0,
                f"{received} of {self._expected} expected inputs have come, and none for {PATIENCE:.0f} s: "
                "call it again with the number that was sent",
            )
