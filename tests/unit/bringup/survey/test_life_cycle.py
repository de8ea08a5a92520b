# SPDX-License-Identifier: Apache-2.0
"""Transitions of the node `survey`, also while a survey runs."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from rclpy.action import GoalResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from rclpy.task import Future

from pipeprog_bringup.survey import node as survey_node
from pipeprog_bringup.survey.survey_journal import Unfinished
from pipeprog_msgs.action import Survey
from pipeprog_msgs.srv import Finish
from tests.access import observer
from tests.unit.bringup.survey.fake_graph import TICK
from tests.unit.bringup.survey.survey_stage import SurveyStage, survey_stage

TIMEOUT = 60.0  # s for what other processes hear within one


def test_a_node_that_is_destroyed_leaves_the_graph(tmp_path: Path) -> None:
    with observer() as node:
        executor = SingleThreadedExecutor(context=node.context)
        with survey_stage(tmp_path / "surveys") as stage:
            stage.until(lambda: "survey" in node.get_node_names())
            stage.activate()
        deadline = time.monotonic() + TIMEOUT
        while "survey" in node.get_node_names() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=TICK)
        assert "survey" not in node.get_node_names()


@pytest.mark.parametrize(
    ("transition", "state"),
    [(Transition.TRANSITION_DEACTIVATE, "inactive"), (Transition.TRANSITION_ACTIVE_SHUTDOWN, "finalized")],
)
def test_a_node_that_is_not_active_any_more_brings_its_survey_to_the_result(
    surveys: SurveyStage, transition: int, state: str
) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="last")
    surveys.let_finish(keyframes=1, revision=1)
    assert surveys.change(transition)
    assert surveys.state == state
    assert not surveys.send(survey_id="next").accepted
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, "")
    assert (Path(answer.result.folder) / "pipes.json").is_file()
    assert not surveys.send(survey_id="next").accepted


def test_cleanup_is_refused_until_the_survey_is_over(surveys: SurveyStage) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="last")
    mapped = Future()
    surveys.let_finish(keyframes=1, revision=1)
    surveys.graph.answers["sfm"][0] = mapped
    assert surveys.change(Transition.TRANSITION_DEACTIVATE)
    surveys.until(lambda: surveys.stage == Survey.Feedback.RECONSTRUCTING)
    assert not surveys.change(Transition.TRANSITION_CLEANUP)
    assert surveys.state == "inactive"
    mapped.set_result(Finish.Response(success=True, outputs=1))
    assert surveys.result(handle).status == GoalStatus.STATUS_SUCCEEDED

    assert surveys.change(Transition.TRANSITION_CLEANUP)
    assert surveys.state == "unconfigured"
    assert not surveys.send(survey_id="next").accepted
    surveys.activate()
    handle = surveys.film(survey_id="next")
    surveys.cancel(handle)
    assert surveys.result(handle).status == GoalStatus.STATUS_CANCELED


def test_an_exception_in_a_transition_leads_to_the_state_unconfigured(
    surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: str) -> None:
        raise RuntimeError("as never expected")

    with monkeypatch.context() as failing:
        failing.setattr(survey_node, "read_site", fail)
        assert not surveys.change(Transition.TRANSITION_CONFIGURE)
    assert surveys.state == "unconfigured"
    surveys.activate()
    assert surveys.state == "active"


def test_a_goal_that_comes_before_a_survey_goes_on_is_of_its_client(
    surveys: SurveyStage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = Unfinished(tmp_path / "monday" / ".pipeprog-1", serialize_message(Survey.Goal(survey_id="monday")))
    monkeypatch.setattr(surveys.node, "_left", left)
    with monkeypatch.context() as waiting:  # the survey has not begun yet
        waiting.setattr(surveys.node.executor, "create_task", lambda *_: None)
        surveys.node.trigger_configure()
        surveys.node.trigger_activate()
    assert surveys.node._on_goal(Survey.Goal(survey_id="tuesday")) == GoalResponse.REJECT
    assert surveys.node._on_goal(Survey.Goal(survey_id="monday")) == GoalResponse.ACCEPT


def test_a_goal_in_a_damaged_journal_leaves_the_node_unconfigured_and_not_active(
    surveys: SurveyStage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surveys.node, "_left", Unfinished(tmp_path / "monday" / ".pipeprog-1", b"\xff"))
    assert surveys.change(Transition.TRANSITION_CONFIGURE)
    assert not surveys.change(Transition.TRANSITION_ACTIVATE)
    assert surveys.state == "unconfigured"
    assert not surveys.send(survey_id="next").accepted
    surveys.activate()
    assert surveys.state == "active"


def test_a_bill_that_cannot_be_read_fails_configure(surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surveys.node, "_boq", "/nowhere/boq.yaml")
    assert not surveys.change(Transition.TRANSITION_CONFIGURE)
    assert surveys.state == "unconfigured"
