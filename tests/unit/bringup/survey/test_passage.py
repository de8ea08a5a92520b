# SPDX-License-Identifier: Apache-2.0
"""A survey's way through nodes that die: each takes it up from its journal, and is asked again what it has not said."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Bool

from pipeprog_bringup.playback.frame_log import LiveFrameLog
from pipeprog_bringup.survey import passage as passages
from pipeprog_bringup.survey.goal import Goal, read_site
from pipeprog_bringup.survey.passage import CONFIGS, MAX_RESTARTS, Passage, SurveyFailure
from pipeprog_msgs.action import Survey
from pipeprog_msgs.srv import Finish, Renew
from pipeprog_node import qos
from pipeprog_node.diagnostics import PROCESS

BAGS = Path(__file__).parents[4] / "bags"
TICK = 0.02  # s
TIMEOUT = 60.0  # s, for what takes one on an idle machine
FRAMES, KEYFRAMES = 0, 7  # inputs of frames and of sfm


class Graph:
    """The services and diagnostics of the three nodes; `die` has one come back as another process.

    Attributes:
        asked: what was called, in order: node, service, and the request's fields that count.
        answers: of each node's Finish, in order; None: it dies over it.
    """

    def __init__(self) -> None:
        self.node = Node("graph")
        self.asked: list[tuple[Any, ...]] = []
        self.answers: dict[str, deque[Finish.Response | None]] = {name: deque() for name in CONFIGS}
        self._processes: Counter[str] = Counter(dict.fromkeys(CONFIGS, 100))
        group = ReentrantCallbackGroup()
        for name in CONFIGS:
            self.node.create_service(Renew, f"{name}/renew", self._renew(name), callback_group=group)
            self.node.create_service(Finish, f"{name}/finish", self._finish(name), callback_group=group)
        self._diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.node.create_timer(TICK, self._tell)

    def die(self, name: str) -> None:
        self._processes[name] += 1

    def _tell(self) -> None:
        told = [
            DiagnosticStatus(name=f"{name}: health", values=[KeyValue(key=PROCESS, value=str(number))])
            for name, number in self._processes.items()
        ]
        self._diagnostics.publish(DiagnosticArray(status=told))

    def _renew(self, name: str) -> Callable[..., Renew.Response]:
        def renew(request: Renew.Request, response: Renew.Response) -> Renew.Response:
            self.asked.append((name, "renew", request.idle, Path(request.journal).name))
            response.success = True
            return response

        return renew

    def _finish(self, name: str) -> Callable[..., Any]:
        async def finish(request: Finish.Request, response: Finish.Response) -> Finish.Response:
            self.asked.append((name, "finish", request.expected_inputs))
            answer = self.answers[name].popleft()
            if answer is None:
                self.die(name)
                await Future()
            assert answer is not None
            return answer

        return finish


class Stage:
    """A passage through the graph in one executor."""

    def __init__(self) -> None:
        self.graph, self._listener = Graph(), Node("listener")
        self._executor = SingleThreadedExecutor()
        for node in (self.graph.node, self._listener):
            self._executor.add_node(node)
        self._waiting: list[Future] = []
        self._listener.create_timer(TICK, self._wake)
        self.passage = Passage(self._listener, self._tick, lambda: False, LiveFrameLog())

    def run(self, coroutine: Any) -> Any:
        task = self._executor.create_task(coroutine)
        self.spin_until(task.done)
        if task.exception() is not None:
            raise task.exception()
        return task.result()

    def begin(self, folder: Path) -> None:
        site = read_site(str(BAGS / "demo.boq.yaml"), "")
        self.run(self.passage.begin(Goal("survey", site, 0.0), folder / "colmap", folder / "journal"))
        self.graph.asked.clear()

    def spin_until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=TICK)

    def close(self) -> None:
        self._executor.shutdown()
        for node in (self.graph.node, self._listener):
            node.destroy_node()

    async def _tick(self) -> None:
        future = Future()
        self._waiting.append(future)
        await future

    def _wake(self) -> None:
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            future.set_result(None)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    monkeypatch.setattr(passages, "missing_connections", lambda *_: [])
    monkeypatch.setattr(passages, "MATCHING_SECONDS", 2 * TICK)
    rclpy.init()
    stage = Stage()
    yield stage
    stage.close()
    rclpy.shutdown()


def test_a_node_that_dies_takes_the_survey_up_and_is_asked_again(stage: Stage, tmp_path: Path) -> None:
    stage.begin(tmp_path)
    good = {"success": True, "outputs": KEYFRAMES}
    stage.graph.answers["frames"].extend([None, Finish.Response(**good)])
    stage.graph.answers["sfm"].extend([None, Finish.Response(success=True, outputs=2)])
    stage.graph.answers["detect"].extend([None, Finish.Response(message="no pipes here")])
    with pytest.raises(SurveyFailure, match="no pipes here"):
        stage.run(stage.passage.work_off())
    assert stage.graph.asked == [
        ("frames", "finish", FRAMES),
        ("frames", "renew", True, "journal"),  # filming is over
        ("frames", "finish", FRAMES),
        ("sfm", "finish", KEYFRAMES),
        ("sfm", "renew", False, "journal"),
        ("sfm", "finish", KEYFRAMES),
        ("detect", "finish", 2),
        ("detect", "renew", False, "journal"),
        ("detect", "finish", 2),
    ]


def test_a_map_that_may_not_have_arrived_is_made_again(stage: Stage, tmp_path: Path) -> None:
    stage.begin(tmp_path)
    stage.graph.answers["frames"].append(Finish.Response(success=True, outputs=KEYFRAMES))
    made = Finish.Response(success=True, outputs=2)
    stage.graph.answers["sfm"].extend([made, made])
    stage.graph.answers["detect"].extend([None, Finish.Response(message="no pipes here")])
    die = stage.graph.die
    stage.graph.die = lambda name: die("sfm") or die(name)  # type: ignore[method-assign]
    with pytest.raises(SurveyFailure, match="no pipes here"):
        stage.run(stage.passage.work_off())
    assert stage.graph.asked.count(("sfm", "finish", KEYFRAMES)) == 2


def test_a_node_that_dies_again_and_again_ends_the_survey(stage: Stage, tmp_path: Path) -> None:
    stage.begin(tmp_path)
    stage.graph.answers["frames"].extend([None] * (MAX_RESTARTS + 1))
    with pytest.raises(SurveyFailure, match=f"died {MAX_RESTARTS + 1} times, the last was frames") as failure:
        stage.run(stage.passage.work_off())
    assert failure.value.code == Survey.Result.PROCESS_DIED


def test_a_node_that_is_started_anew_hears_of_the_pause(stage: Stage, tmp_path: Path) -> None:
    stage.begin(tmp_path)
    stage.passage.pause(True)
    heard: list[bool] = []
    late = stage.graph.node
    late.create_subscription(Bool, "survey/paused", lambda message: heard.append(message.data), qos.latched())
    stage.spin_until(lambda: heard == [True])
    stage.run(stage.passage.rest())
    stage.spin_until(lambda: heard == [True, False])
