# SPDX-License-Identifier: Apache-2.0
"""What the client of a survey hears while it runs."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.task import Future

from pipeprog_bringup.playback.frame_log import LOST_AFTER
from pipeprog_bringup.survey import conducted_survey
from pipeprog_bringup.survey.advice import advice
from pipeprog_bringup.survey.time_remaining import TimeRemaining
from pipeprog_msgs.action import Survey
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages
from tests.unit.bringup.survey.fake_graph import Graph
from tests.unit.bringup.survey.survey_stage import SurveyStage, survey_stage


def keeps_filming(graph: Graph) -> bool:
    """Another image that is no keyframe."""
    graph.pass_over("overlap")
    return True


def test_missing_input_is_told_before_lost_tracking_and_that_before_the_problem_of_the_sfm() -> None:
    place = (0.0, 0.0, 0.0)
    assert advice("no image", True, place, "blurred") == "no image"
    assert "tracking" in advice("", True, place, "blurred")
    assert advice("", False, place, "blurred") == "blurred"
    assert advice("", False, place, "") == ""


def test_lost_tracking_names_the_place_to_walk_back_to() -> None:
    told = advice("", True, (1.234, -0.56, 1.5), "")
    assert "walk back to x 1.2 m, y -0.6 m, z 1.5 m in the frame map" in told


def test_lost_tracking_without_a_known_pose_names_no_place() -> None:
    told = advice("", True, None, "")
    assert "walk back the way you came" in told
    assert " m," not in told


def test_a_survey_that_loses_tracking_says_so_until_it_is_found_again(surveys: SurveyStage) -> None:
    surveys.activate()
    handle = surveys.film(survey_id="lost")
    graph = surveys.graph
    assert surveys.feedback[-1].tracking
    graph.report(message="film the board from more sides")
    surveys.until(lambda: surveys.feedback[-1].advice == "film the board from more sides")
    assert surveys.feedback[-1].last_known == PoseStamped()  # nothing is known yet

    for _ in range(2):
        graph.add_keyframe(True)
    graph.publish_poses((9.0, 9.0, 9.0), (2.0, -1.0, 1.5))  # the last one counts
    for _ in range(LOST_AFTER):
        graph.add_keyframe(False)
    surveys.until(lambda: not surveys.feedback[-1].tracking and surveys.feedback[-1].last_known != PoseStamped())
    lost = surveys.feedback[-1]
    assert lost.last_known.header.frame_id == "map"
    assert (lost.last_known.pose.position.x, lost.last_known.pose.position.y) == (2.0, -1.0)
    assert lost.advice == advice("", True, (2.0, -1.0, 1.5), "")

    graph.add_keyframe(True)
    surveys.until(lambda: surveys.feedback[-1].tracking)
    assert surveys.feedback[-1].advice == "film the board from more sides"
    surveys.cancel(handle)
    assert surveys.result(handle).result.error_msg == ""


def test_images_that_do_not_come_are_told_before_lost_tracking(
    surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conducted_survey, "PATIENCE", 0.5)
    surveys.activate()
    handle = surveys.film(survey_id="dark")
    for _ in range(LOST_AFTER):
        surveys.graph.add_keyframe(False)
    surveys.until(lambda: surveys.feedback[-1].advice.startswith("no image for"))
    assert not surveys.feedback[-1].tracking
    assert "nobody publishes /image/compressed" in surveys.feedback[-1].advice
    surveys.cancel(handle)
    surveys.result(handle)


def test_nobody_is_to_walk_back_once_filming_has_ended(surveys: SurveyStage) -> None:
    surveys.activate()
    handle = surveys.film(survey_id="over")
    for _ in range(LOST_AFTER):
        surveys.graph.add_keyframe(False)
    surveys.until(lambda: surveys.feedback[-1].advice)
    surveys.graph.answers["frames"].append(Future())
    surveys.end()
    surveys.until(lambda: surveys.stage == Survey.Feedback.RECONSTRUCTING)
    assert not surveys.feedback[-1].tracking
    assert surveys.feedback[-1].advice == ""
    surveys.cancel(handle)
    surveys.result(handle)


def test_time_that_remains_is_unknown_before_the_work_moves() -> None:
    remaining = TimeRemaining()
    assert remaining.at(100.0, math.nan) == 0.0  # filming
    assert remaining.at(110.0, 0.3) == 0.0  # what was done while filming tells no pace
    assert remaining.at(115.0, 0.3) == 0.0
    assert remaining.at(120.0, 0.3 + 1e-9) == 0.0  # one of many keyframes: years by its pace
    assert remaining.at(120.0, 0.4) == pytest.approx(60.0)


def test_time_that_remains_follows_the_pace_since_filming_and_counts_down() -> None:
    remaining = TimeRemaining()
    remaining.at(100.0, 0.2)
    assert remaining.at(110.0, 0.4) == pytest.approx(30.0)  # 0.2 in 10 s, 0.6 are left
    assert remaining.at(115.0, 0.4) == pytest.approx(25.0)
    assert remaining.at(120.0, 0.8) == pytest.approx(20.0 / 3.0)  # 0.6 in 20 s, 0.2 are left


def test_time_that_remains_is_unknown_where_the_work_takes_longer_than_expected() -> None:
    remaining = TimeRemaining()
    remaining.at(100.0, 0.0)
    assert remaining.at(110.0, 0.5) == pytest.approx(10.0)
    assert remaining.at(150.0, 0.5) == 0.0


def test_the_time_that_remains_is_told_after_filming(surveys: SurveyStage) -> None:
    surveys.activate()
    handle = surveys.film(survey_id="timed")
    graph = surveys.graph
    graph.add_keyframe(True)
    surveys.until(lambda: surveys.feedback[-1].keyframes == 1)
    assert math.isnan(surveys.feedback[-1].progress)
    graph.answers["frames"].append(Finish.Response(success=True, outputs=1))
    mapped = Future()
    graph.answers["sfm"].append(mapped)
    graph.answers["detect"].append(Future())
    surveys.end()
    surveys.until(lambda: surveys.stage == Survey.Feedback.RECONSTRUCTING)
    mapped.set_result(Finish.Response(success=True, outputs=1))
    surveys.until(lambda: surveys.stage == Survey.Feedback.MEASURING)
    unknown = Duration()
    assert all(told.estimated_time_remaining == unknown for told in surveys.feedback if told.state < told.MEASURING)
    began, now = (
        next(told for told in surveys.feedback if told.state == state)
        for state in (Survey.Feedback.RECONSTRUCTING, Survey.Feedback.MEASURING)
    )
    worked = messages.seconds(now.elapsed) - messages.seconds(began.elapsed)
    expected = worked * (1.0 - now.progress) / (now.progress - began.progress)
    assert messages.seconds(now.estimated_time_remaining) == pytest.approx(expected, rel=1e-3)
    surveys.cancel(handle)
    surveys.result(handle)


def test_odometry_that_does_not_come_is_told_where_there_is_no_board(tmp_path: Path) -> None:
    with survey_stage(tmp_path / "surveys", board="''") as surveys:
        surveys.activate()
        handle = surveys.film(survey_id="no_metres")
        graph = surveys.graph
        graph.add_keyframe(True)
        graph.report(models=1, keyframes_registered=2, message="the scale is not known")
        surveys.until(lambda: surveys.feedback[-1].advice.startswith("nothing tells the scale: nobody publishes /odom"))
        graph.report(models=1, keyframes_registered=2, metric=True)  # by a rig, or by TF
        surveys.until(lambda: keeps_filming(graph) and surveys.feedback[-1].advice == "")
        surveys.cancel(handle)
        surveys.result(handle)


def test_nothing_is_said_of_odometry_where_a_board_tells_the_scale(
    surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conducted_survey, "ROOM_PERIOD", 0.1)  # s; it looks for input more often than it tells
    surveys.activate()
    handle = surveys.film(survey_id="board")
    surveys.graph.report(models=1, keyframes_registered=2, message="film the board from more sides")
    surveys.until(lambda: surveys.feedback[-1].advice)
    told_before = len(surveys.feedback)
    surveys.until(lambda: keeps_filming(surveys.graph) and len(surveys.feedback) > told_before + 2)
    assert {told.advice for told in surveys.feedback} == {"", "film the board from more sides"}
    surveys.cancel(handle)
    surveys.result(handle)
