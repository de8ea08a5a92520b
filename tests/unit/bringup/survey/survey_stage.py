# SPDX-License-Identifier: Apache-2.0
"""The node `survey` among fake nodes, and the client of its action, in one executor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from pipeprog_bringup.survey.node import SurveyNode
from pipeprog_msgs.action import Survey
from pipeprog_msgs.srv import Finish
from tests.unit.bringup.survey.fake_graph import TICK, Graph

BAGS = Path(__file__).parents[4] / "bags"
BOQ, BOARD = BAGS / "demo.boq.yaml", BAGS / "demo.board.yaml"
TIMEOUT = 60.0  # s, for what takes one on an idle machine


class SurveyStage:
    """Attributes:
    graph: the three other nodes.
    robot: the node of the robot, with the client of the action.
    node: the one under test.
    feedback: on the last goal.
    """

    def __init__(self) -> None:
        self.graph, self.robot, self.node = Graph(), Node("robot"), SurveyNode()
        self.feedback: list[Survey.Feedback] = []
        self._executor = SingleThreadedExecutor()
        for node in (*self.graph.nodes, self.robot, self.node):
            self._executor.add_node(node)
        self._change = self.robot.create_client(ChangeState, "survey/change_state")
        self._state = self.robot.create_client(GetState, "survey/get_state")
        self._end = self.robot.create_client(Trigger, "survey/end")
        self._action = ActionClient(self.robot, Survey, "survey")

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=TICK)

    def change(self, transition: int) -> bool:
        """Whether the transition succeeded."""
        return bool(self._call(self._change, ChangeState.Request(transition=Transition(id=transition))).success)

    def activate(self) -> None:
        assert self.change(Transition.TRANSITION_CONFIGURE)
        assert self.change(Transition.TRANSITION_ACTIVATE)

    @property
    def state(self) -> str:
        """Of the life cycle."""
        return str(self._call(self._state, GetState.Request()).current_state.label)

    def send(self, **goal: Any) -> Any:
        """The handle of a goal."""
        self.feedback.clear()
        self.until(self._action.server_is_ready)
        sent = self._action.send_goal_async(Survey.Goal(**goal), lambda heard: self.feedback.append(heard.feedback))
        self.until(sent.done)
        return sent.result()

    def film(self, **goal: Any) -> Any:
        """The handle of a goal that is filmed; the graph is heard."""
        handle = self.send(**goal)
        assert handle.accepted
        self.until(lambda: self.stage == Survey.Feedback.FILMING and self.graph.is_heard)
        return handle

    def film_a_map(self, **goal: Any) -> Any:
        """The handle of a goal of which a map with a pipe is there."""
        handle = self.film(**goal)
        self.graph.add_keyframe(True)
        self.graph.publish_map(1)
        self.until(lambda: self.feedback[-1].classes)
        return handle

    @property
    def stage(self) -> int:
        """State of the last feedback; 0: none has come."""
        return self.feedback[-1].state if self.feedback else 0

    def let_finish(self, keyframes: int, revision: int) -> None:
        """The answers of the graph to a survey with a map."""
        for name, outputs in (("frames", keyframes), ("sfm", revision), ("detect", 1)):
            self.graph.answers[name].append(Finish.Response(success=True, outputs=outputs))

    def end(self) -> None:
        """Ends filming."""
        assert self._call(self._end, Trigger.Request()).success

    def cancel(self, handle: Any) -> None:
        self.until(handle.cancel_goal_async().done)

    def result(self, handle: Any) -> Any:
        """Status and result of a goal."""
        asked = handle.get_result_async()
        self.until(asked.done)
        return asked.result()

    def close(self) -> None:
        self._executor.shutdown()
        self._action.destroy()
        for node in (*self.graph.nodes, self.robot, self.node):
            node.destroy_node()

    def _call(self, client: Any, request: Any) -> Any:
        self.until(client.service_is_ready)
        asked = client.call_async(request)
        self.until(asked.done)
        return asked.result()


@contextmanager
def survey_stage(results: Path, **parameters: str) -> Iterator[SurveyStage]:
    """The stage with these parameters of the node `survey`, which writes into `results`."""
    given = {"boq": str(BOQ), "board": str(BOARD), "results": str(results)} | parameters
    arguments = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    rclpy.init(args=["--ros-args", "--log-level", "fatal", *arguments])
    stage = SurveyStage()
    try:
        yield stage
    finally:
        stage.close()
        rclpy.try_shutdown()
