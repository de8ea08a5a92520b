# SPDX-License-Identifier: Apache-2.0
"""A survey's way through the graph, which may give no map, and through nodes that die or do not answer.

One that dies takes the survey up from its journal, and is asked again what it has not answered.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Bool

from pipeprog_bringup.playback.frame_log import LiveFrameLog
from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_bringup.survey import passage as passages
from pipeprog_bringup.survey.goal import Goal, read_site
from pipeprog_bringup.survey.passage import MAX_RESTARTS, Cancelled, Passage, SurveyFailure
from pipeprog_frames.frame_decision import UNCALIBRATED
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import SfmStatus
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
        self.is_cancelled = False
        self.passage = Passage(self._listener, self._tick, lambda: self.is_cancelled, LiveFrameLog())

    def start(self, coroutine: Any) -> Any:
        return self._executor.create_task(coroutine)

    def run(self, coroutine: Any) -> Any:
        task = self.start(coroutine)
        self.spin_until(task.done)
        if task.exception() is not None:
            raise task.exception()
        return task.result()

    def begin(self, folder: Path) -> None:
        self.run(self.beginning(folder))
        self.graph.asked.clear()

    def beginning(self, folder: Path) -> Any:
        site = read_site(str(BAGS / "demo.boq.yaml"), "")
        return self.passage.begin(Goal("survey", site, 0.0), folder / "colmap", folder / "journal")

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


def test_a_node_that_dies_before_it_was_heard_begins_once_it_is_there_again(stage: Stage, tmp_path: Path) -> None:
    stage.graph.is_silent, stage.graph.dying = True, ["frames"]
    begun = stage.start(stage.beginning(tmp_path))
    stage.spin_until(lambda: stage.graph.is_found)
    stage.graph.is_silent = False  # one that is asked before this dies unnoticed
    stage.spin_until(begun.done)
    assert begun.exception() is None
    assert [name for name, *_ in stage.graph.asked] == ["frames", "frames", "detect", "sfm", "frames"]


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
    late = stage.graph.nodes[0]
    late.create_subscription(Bool, "survey/paused", lambda message: heard.append(message.data), qos.latched())
    stage.spin_until(lambda: heard == [True])
    stage.run(stage.passage.rest())
    stage.spin_until(lambda: heard == [True, False])


@pytest.mark.parametrize(
    ("reason", "code", "told"),
    [
        ("", Survey.Result.NO_IMAGES, "no image has come"),
        (UNCALIBRATED, Survey.Result.NO_CALIBRATION, "no usable CameraInfo has come"),
        ("blurred", Survey.Result.NO_MAP, "no image could be used as a keyframe: 1 x blurred"),
    ],
)
def test_a_survey_without_keyframes_says_why(stage: Stage, tmp_path: Path, reason: str, code: int, told: str) -> None:
    stage.begin(tmp_path)
    if reason:
        stage.passage.log.decide(FrameRow(1, False, reason))
    stage.graph.answers["frames"].append(Finish.Response(success=True, outputs=0))
    with pytest.raises(SurveyFailure, match=told) as failure:
        stage.run(stage.passage.work_off())
    assert failure.value.code == code


@pytest.mark.parametrize(
    ("status", "code", "told"),
    [
        (SfmStatus(models=1, message="no board was seen"), Survey.Result.NO_SCALE, "no board was seen"),
        (SfmStatus(models=0, message="film textured surroundings"), Survey.Result.NO_MAP, "film textured surroundings"),
        (SfmStatus(models=2, message="two parts"), Survey.Result.NO_MAP, "two parts"),
        (SfmStatus(models=1, metric=True), Survey.Result.NO_MAP, "the SfM says why"),
    ],
)
def test_a_survey_without_a_map_says_why(stage: Stage, tmp_path: Path, status: SfmStatus, code: int, told: str) -> None:
    stage.begin(tmp_path)
    stage.passage.listener.status = status
    stage.graph.answers["frames"].append(Finish.Response(success=True, outputs=KEYFRAMES))
    stage.graph.answers["sfm"].append(Finish.Response(success=False, message="the SfM says why"))
    with pytest.raises(SurveyFailure, match=told) as failure:
        stage.run(stage.passage.work_off())
    assert failure.value.code == code


def test_a_node_that_does_not_answer_ends_the_survey(
    stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.begin(tmp_path)
    monkeypatch.setattr(passages, "FINISH_SECONDS", 10 * TICK)
    stage.graph.answers["frames"].append(Future())
    with pytest.raises(SurveyFailure, match="the node frames has not answered") as failure:
        stage.run(stage.passage.work_off())
    assert failure.value.code == Survey.Result.TIMEOUT


def test_a_node_that_is_not_there_ends_the_survey(
    stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.graph.leave("frames")
    monkeypatch.setattr(passages, "DELIVERY_SECONDS", 10 * TICK)
    with pytest.raises(SurveyFailure, match="the node frames is not there") as failure:
        stage.begin(tmp_path)
    assert failure.value.code == Survey.Result.TIMEOUT


def test_a_cancelled_survey_does_not_wait_for_a_node_that_is_still_starting(stage: Stage, tmp_path: Path) -> None:
    stage.graph.leave("sfm")
    beginning = stage.start(stage.beginning(tmp_path))
    stage.spin_until(lambda: ("detect", "renew", False, "journal") in stage.graph.asked)
    stage.is_cancelled = True
    with pytest.raises(Cancelled):
        stage.spin_until(beginning.done)
    stage.is_cancelled = False  # it is obeyed
    stage.graph.asked.clear()
    stage.run(stage.passage.rest())
    assert stage.graph.asked == [("frames", "renew", True, ""), ("detect", "renew", False, "")]


def test_a_survey_that_is_over_waits_for_a_node_that_has_begun_it(
    stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.begin(tmp_path)
    stage.graph.leave("sfm")
    monkeypatch.setattr(passages, "DELIVERY_SECONDS", 10 * TICK)
    with pytest.raises(SurveyFailure, match="the node sfm is not there"):
        stage.run(stage.passage.rest())


def test_nodes_that_do_not_find_each_other_end_the_survey(
    stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.begin(tmp_path)
    monkeypatch.setattr(passages, "missing_connections", lambda *_: ["detect does not subscribe to map_points"])
    monkeypatch.setattr(passages, "DELIVERY_SECONDS", 10 * TICK)
    with pytest.raises(SurveyFailure, match="the nodes have not found each other") as failure:
        stage.run(stage.passage.go_on({}))
    assert failure.value.code == Survey.Result.TIMEOUT


def test_pipes_that_do_not_come_end_the_survey(stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage.begin(tmp_path)
    monkeypatch.setattr(passages, "DELIVERY_SECONDS", 1.0)
    for name, outputs in (("frames", KEYFRAMES), ("sfm", 2), ("detect", 1)):
        stage.graph.answers[name].append(Finish.Response(success=True, outputs=outputs))
    with pytest.raises(SurveyFailure, match="the last pipes have not come") as failure:
        stage.run(stage.passage.work_off())
    assert failure.value.code == Survey.Result.TIMEOUT
