# SPDX-License-Identifier: Apache-2.0
"""A survey's way through nodes that die: each takes it up from its journal, and is asked again what it has not said."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Bool

from pipeprog_bringup.playback.frame_log import LiveFrameLog
from pipeprog_bringup.survey import passage as passages
from pipeprog_bringup.survey.goal import Goal, read_site
from pipeprog_bringup.survey.passage import MAX_RESTARTS, Passage, SurveyFailure
from pipeprog_msgs.action import Survey
from pipeprog_msgs.srv import Finish
from pipeprog_node import qos
from tests.unit.bringup.survey.fake_graph import TICK, Graph

BAGS = Path(__file__).parents[4] / "bags"
TIMEOUT = 60.0  # s, for what takes one on an idle machine
FRAMES, KEYFRAMES = 0, 7  # inputs of frames and of sfm


class Stage:
    """A passage through the graph in one executor."""

    def __init__(self) -> None:
        self.graph, self._listener = Graph(), Node("listener")
        self._executor = SingleThreadedExecutor()
        for node in (*self.graph.nodes, self._listener):
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
        for node in (*self.graph.nodes, self._listener):
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
