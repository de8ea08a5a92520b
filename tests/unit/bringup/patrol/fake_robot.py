# SPDX-License-Identifier: Apache-2.0
"""The other sides of a patrol over real DDS, in a thread: the node survey, Nav2's and Spot's actions. No computing."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from nav2_msgs.action import FollowWaypoints
from nav2_msgs.msg import MissedWaypoint
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from spot_msgs.action import NavigateTo
from std_srvs.srv import Trigger

from pipeprog_msgs.action import Survey

WAIT = 0.02  # s between two looks


class FakeRobot(Node):
    """Does what it is asked to.

    Attributes:
        said: goals, ends and moves in their order.
        failing: error messages of the next surveys, one each; an empty one succeeds.
        blocked: waypoints that are not reached.
        is_killed: whether nothing is heard of the first survey.
        ends_itself: whether the survey after that one ends at once.
    """

    def __init__(self) -> None:
        super().__init__("fake_robot")
        self.said: list[str] = []
        self.failing: list[str] = []
        self.blocked: set[str] = set()
        self.is_killed = self._is_lost = self._is_filming = self._end_asked = False
        self.ends_itself = True
        self._filmed = ""
        group = ReentrantCallbackGroup()
        options: dict[str, Any] = {"callback_group": group}
        self._actions = [
            ActionServer(
                self,
                Survey,
                "survey",
                self._survey,
                goal_callback=self._on_goal,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
                **options,
            ),
            ActionServer(self, FollowWaypoints, "follow_waypoints", self._follow, **options),
            ActionServer(self, NavigateTo, "spot/navigate_to", self._walk, **options),
        ]
        self.create_service(Trigger, "survey/end", self._on_end, **options)
        self.create_service(Trigger, "spot/stop", self._on_stop, **options)

    def _on_goal(self, goal: Survey.Goal) -> GoalResponse:
        """Notes an accepted goal here: its client may go on before another thread executes it."""
        if self._is_filming:  # as the node survey: a goal of the same name joins the survey that runs
            return GoalResponse.ACCEPT if goal.survey_id and goal.survey_id == self._filmed else GoalResponse.REJECT
        self._is_lost = self.is_killed and not self.said
        self._is_filming = not self._is_lost
        self._end_asked = self.is_killed and self.ends_itself and not self._is_lost
        self.said.append(f"survey {goal.survey_id}")
        self._filmed = goal.survey_id
        return GoalResponse.ACCEPT

    def _survey(self, handle: Any) -> Survey.Result:
        name = handle.request.survey_id
        if self._is_lost:
            while rclpy.ok() and len(self.said) < 2:
                time.sleep(WAIT)
            return Survey.Result()
        while rclpy.ok() and not self._end_asked and not handle.is_cancel_requested:
            handle.publish_feedback(Survey.Feedback(state=Survey.Feedback.FILMING))
            time.sleep(WAIT)
        self._is_filming = False
        error = self.failing.pop(0) if self.failing else ""
        if handle.is_cancel_requested or not rclpy.ok():
            handle.canceled()
        elif error:
            handle.abort()
        else:
            handle.succeed()
        return Survey.Result(
            error_code=Survey.Result.NO_MAP if error else 0, error_msg=error, folder=f"/surveys/{name}"
        )

    def _follow(self, handle: Any) -> FollowWaypoints.Result:
        places = [f"{pose.pose.position.x:g}" for pose in handle.request.poses]
        self.said.append(f"follow {' '.join(places)}")
        handle.succeed()
        missed = [MissedWaypoint(index=number) for number, place in enumerate(places) if place in self.blocked]
        return FollowWaypoints.Result(missed_waypoints=missed)

    def _walk(self, handle: Any) -> NavigateTo.Result:
        waypoint = handle.request.waypoint_id
        self.said.append(f"walk {waypoint}")
        handle.succeed()
        return NavigateTo.Result(success=waypoint not in self.blocked, message="no way" * (waypoint in self.blocked))

    def _on_end(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.said += ["end"] if self._is_filming and not self._end_asked else []
        response.success = self._end_asked = self._is_filming
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.said.append("stop")
        response.success = True
        return response


@contextmanager
def fake_robot() -> Iterator[FakeRobot]:
    """A robot whose actions are answered while the context is open."""
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    robot = FakeRobot()
    executor = MultiThreadedExecutor(4)
    executor.add_node(robot)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield robot
    finally:
        rclpy.try_shutdown()
        executor.shutdown()
        thread.join(10.0)
        robot.destroy_node()
