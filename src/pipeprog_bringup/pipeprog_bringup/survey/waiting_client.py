# SPDX-License-Identifier: Apache-2.0
"""Whoever waits for a survey: nobody for a while, where the node `survey` was killed and its goal with it."""

from __future__ import annotations

from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from pipeprog_msgs.action import Survey


class Client:
    """The goal of the action that a survey answers.

    Attributes:
        name: of the survey; empty while it has none.
        handle: the last goal that asked for it; None: none has come since the node was started anew.
        result: that of the survey, once it is over.
    """

    def __init__(self, name: str, handle: ServerGoalHandle | None) -> None:
        self.name, self.handle = name, handle
        self._is_lost = handle is None  # and answers may get lost that are given before the two have found each other
        self.result = Future()

    @property
    def is_cancel_requested(self) -> bool:
        """Whether the survey is not wanted any more."""
        return self.handle is not None and bool(self.handle.is_cancel_requested)

    def publish_feedback(self, feedback: Survey.Feedback) -> None:
        """Tells where the survey stands."""
        if self.handle is not None:
            self.handle.publish_feedback(feedback)

    def is_of(self, goal: Survey.Goal) -> bool:
        """Whether a goal asks again for this survey, whose client the node has lost."""
        return self._is_lost and goal.survey_id == self.name
