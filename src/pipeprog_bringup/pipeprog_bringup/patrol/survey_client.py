# SPDX-License-Identifier: Apache-2.0
"""A client of the action `survey`, for what drives a robot: patrols, and the programs of examples/."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from pipeprog_bringup.patrol.round import Surveyed
from pipeprog_camera.errors import InputError
from pipeprog_msgs.action import Survey
from pipeprog_node import messages

ANSWER_SECONDS = 10.0  # for an answer of the node survey: it computes nothing itself
START_SECONDS = 900.0  # until a goal is accepted: a survey of before may be worked off still, 5 minutes for a field
# s without feedback, of which two a second come: then the node was killed. A server that was killed stays in the
# graph for the 20 s of its lease, and the one that follows is there before.
SILENT_SECONDS = 10.0
GONE_SECONDS = 30.0  # from then on, until the survey is given up: a supervisor starts the node anew within seconds
# s from finding a server to the first goal: it must have found this client, too, or its answer is lost (rclpy#1123).
# On two busy cores that once took more than one second.
MATCHING_SECONDS = 2.0
MOST_TIMES_ASKED = 3  # of a goal that moves the robot: one lost answer is rare, three mean that the driver is gone
PAUSE = 1.0  # s between two goals, while none is accepted
_SPIN = 0.05  # s between two looks at what is waited for


class SurveyClient:
    """Sends goals to the node survey. It spins its node while it waits, so nobody else may.

    Attributes:
        feedback: the last one of the survey that runs or has run; None before the first.
    """

    def __init__(self, node: Node, name: str = "survey", start_seconds: float = START_SECONDS) -> None:
        """`name`: of the action; `start_seconds`: until a goal must have been accepted."""
        self.feedback: Survey.Feedback | None = None
        self._name, self._start_seconds = name, start_seconds
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._action = ActionClient(node, Survey, name)
        self._end = node.create_client(Trigger, f"{name}/end")
        self._matched: set[ActionClient] = set()
        self._goal, self._heard = Survey.Goal(), 0.0  # the goal, and when its survey was last heard of
        self._end_asked = False
        self._handle: ClientGoalHandle | None = None
        self._result: Future | None = None

    @property
    def is_over(self) -> bool:
        """Whether no survey runs."""
        return self._result is None or self._result.done()

    def start(
        self, survey_id: str = "", boq: str = "", board: str = "", seconds: float = 0.0, reference: str = ""
    ) -> None:
        """Begins a survey, fields as of its goal; raises InputError where the node does not accept it."""
        files = {"boq": boq, "board": board, "reference": reference}
        self._goal = Survey.Goal(survey_id=survey_id, time_limit=messages.duration_msg(seconds), **files)
        self._end_asked = False
        deadline = time.monotonic() + self._start_seconds
        while not self._accepted(self._goal):
            if time.monotonic() + PAUSE > deadline:
                raise InputError(
                    f"the node {self._name} has accepted no goal for {self._start_seconds:g} s: is it active "
                    f"(`ros2 lifecycle set /{self._name} activate`), and does no other survey run?"
                )
            self.wait(lambda: False, PAUSE)
        assert self._handle is not None
        self._result = self._handle.get_result_async()

    def end(self) -> None:
        """Ends filming, if a survey is filmed; the survey goes on to its result."""
        self._end_asked = True
        deadline = time.monotonic() + ANSWER_SECONDS
        # A goal that has just been accepted is not executed yet: then the node says that there is none.
        while not self._has_ended() and not self.is_over and time.monotonic() < deadline:
            self.wait(lambda: False, _SPIN)

    def cancel(self) -> None:
        """Gives the survey up, if one runs: what there is is written."""
        if not self.is_over and self._handle is not None:
            self.wait(self._handle.cancel_goal_async().done, ANSWER_SECONDS)

    def result(self) -> Surveyed:
        """Waits for the result of the survey that was started.

        A node that is started anew goes on with a survey; the goal is sent to it once more, if the survey has a name,
        and so is the wish to end filming, which it may not know of.
        """
        assert self._result is not None
        began = time.monotonic()  # nothing is heard while nobody waits
        while not self.wait(lambda: self.is_over, PAUSE):
            is_silent = time.monotonic() > max(self._heard, began) + SILENT_SECONDS
            if is_silent and not self._is_answered() and not self._is_taken_up():
                self._result = None
                return Surveyed(False, f"the node {self._name} is gone, and its survey with it", "")
        answer = self._result.result()
        succeeded = answer.status == GoalStatus.STATUS_SUCCEEDED
        error = answer.result.error_msg or ("" if succeeded else "the survey was cancelled")
        return Surveyed(succeeded, error, answer.result.folder)

    def _is_answered(self) -> bool:
        """Whether the node has the result: a request for it is lost while the node has not found this client yet."""
        assert self._handle is not None
        asked = self._handle.get_result_async()
        if not self.wait(asked.done, PAUSE) or asked.result().status == GoalStatus.STATUS_UNKNOWN:
            return False  # one that was started anew does not know the goal
        self._result = asked
        return True

    def _is_taken_up(self) -> bool:
        """Whether the survey goes on: it is heard of again, or the node takes the goal once more."""
        self._matched.discard(self._action)
        silent, deadline = self._heard, time.monotonic() + GONE_SECONDS
        while time.monotonic() < deadline and self._heard == silent and not self.is_over:
            if self._goal.survey_id and self._accepted(self._goal):
                assert self._handle is not None
                self._result = self._handle.get_result_async()
                if self._end_asked:
                    self.end()
                return True
            self.wait(lambda: self.is_over or self._heard > silent, PAUSE)
        return self._heard > silent or self.is_over

    def drive(self, action: ActionClient, goal: Any, seconds: float) -> Any:
        """The result of an action of the same node that moves the robot, while the survey goes on.

        Raises InputError, with the action cancelled, where it is not accepted, or not over after `seconds`.
        """
        handle = self._answer(action, goal)
        if not handle.accepted:
            raise InputError("the action that moves the robot has refused the goal")
        over = handle.get_result_async()
        if not self.wait(over.done, seconds):
            self.wait(handle.cancel_goal_async().done, ANSWER_SECONDS)
            raise InputError(f"the robot has not arrived after {seconds:g} s")
        return over.result().result

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Lets the node work until a condition holds, for `seconds` at most; returns whether it does."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=_SPIN)
        return True

    def close(self) -> None:
        """Takes the client out of its node."""
        self._action.destroy()
        self._executor.shutdown()

    def _has_ended(self) -> bool:
        if not self.wait(self._end.service_is_ready, ANSWER_SECONDS):
            return False
        answer = self._end.call_async(Trigger.Request())
        return self.wait(answer.done, ANSWER_SECONDS) and bool(answer.result().success)

    def _is_ready(self, action: ActionClient) -> bool:
        """Whether a server is there that answers this client."""
        if not self.wait(action.server_is_ready, ANSWER_SECONDS):
            self._matched.discard(action)
            return False
        if action not in self._matched:
            self.wait(lambda: False, MATCHING_SECONDS)
            self._matched.add(action)
        return True

    def _answer(self, action: ActionClient, goal: Any) -> ClientGoalHandle:
        """What a server says to a goal; it is asked again where the answer is lost: the place to go to is the same."""
        for _ in range(MOST_TIMES_ASKED):
            if not self._is_ready(action):
                raise InputError("the action that moves the robot is not there: is its driver running?")
            sent = action.send_goal_async(goal)
            if self.wait(sent.done, ANSWER_SECONDS):
                return sent.result()
            self._matched.discard(action)
        raise InputError(f"the action that moves the robot has not answered, asked {MOST_TIMES_ASKED} times")

    def _accepted(self, goal: Survey.Goal) -> bool:
        if not self._is_ready(self._action):
            return False
        sent = self._action.send_goal_async(goal, self._on_feedback)
        if not self.wait(sent.done, ANSWER_SECONDS):
            return False
        handle = sent.result()
        if handle is None or not handle.accepted:
            return False
        self._handle, self._heard = handle, time.monotonic()
        return True

    def _on_feedback(self, heard: Survey.Impl.FeedbackMessage) -> None:
        self.feedback, self._heard = heard.feedback, time.monotonic()
