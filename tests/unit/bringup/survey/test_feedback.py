# SPDX-License-Identifier: Apache-2.0
"""What the client of a survey hears while it runs."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.task import Future

from pipeprog_bringup.playback.frame_log import LOST_AFTER
from pipeprog_bringup.survey import conducted_survey
from pipeprog_bringup.survey.advice import advice
from pipeprog_msgs.action import Survey
from tests.unit.bringup.survey.survey_stage import SurveyStage


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
