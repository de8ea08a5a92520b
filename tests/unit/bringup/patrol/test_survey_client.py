# SPDX-License-Identifier: Apache-2.0
"""The client of the action `survey` against a node that is killed."""

from __future__ import annotations

import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from spot_msgs.action import NavigateTo

from pipeprog_bringup.patrol import survey_client
from pipeprog_bringup.patrol.round import Surveyed
from pipeprog_bringup.patrol.survey_client import MOST_TIMES_ASKED, SurveyClient
from pipeprog_camera.errors import InputError
from tests.unit.bringup.patrol.fake_robot import fake_robot

LOST = Surveyed(False, "the node survey is gone, and its survey with it", "")


@pytest.mark.parametrize(("name", "found"), [("monday", Surveyed(True, "", "/surveys/monday")), ("", LOST)])
def test_a_survey_with_a_name_is_asked_for_again_where_nothing_is_heard_of_it(
    name: str, found: Surveyed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survey_client, "SILENT_SECONDS", 1.0)
    monkeypatch.setattr(survey_client, "GONE_SECONDS", 10.0 if name else 1.0)
    with fake_robot() as robot:
        robot.is_killed = True
        client = SurveyClient(rclpy.create_node("mission"))
        client.start(name)
        assert client.result() == found
        assert robot.said == [f"survey {name}"] * (2 if name else 1)
        client.close()


def test_filming_is_ended_once_more_where_the_node_was_killed_before_it_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(survey_client, "SILENT_SECONDS", 1.0)
    with fake_robot() as robot:
        robot.is_killed, robot.ends_itself = True, False
        client = SurveyClient(rclpy.create_node("mission"))
        client.start("monday")
        with monkeypatch.context() as soon:
            soon.setattr(survey_client, "ANSWER_SECONDS", 1.0)
            client.end()
        assert client.result() == Surveyed(True, "", "/surveys/monday")
        assert robot.said == ["survey monday", "survey monday", "end"]
        client.close()


class Deaf(ActionClient):
    """Its first request for a result is lost."""

    is_lost = True

    def _get_result_async(self, handle: ClientGoalHandle) -> Future:
        lost, self.is_lost = self.is_lost, False
        return Future() if lost else super()._get_result_async(handle)


@pytest.mark.parametrize("name", ["monday", ""])
def test_a_result_is_asked_for_again_where_the_request_was_lost(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey_client, "SILENT_SECONDS", 1.0)
    monkeypatch.setattr(survey_client, "ActionClient", Deaf)
    with fake_robot() as robot:
        client = SurveyClient(rclpy.create_node("mission"))
        client.start(name)
        client.end()
        assert client.result() == Surveyed(True, "", f"/surveys/{name}")
        assert robot.said == [f"survey {name}", "end"]
        client.close()


class Lossy(ActionClient):
    """Hears nothing of its first goals, which the server works off all the same."""

    lost = 0

    def send_goal_async(self, *goal: NavigateTo.Goal) -> Future:
        sent = super().send_goal_async(*goal)
        self.lost -= 1
        return sent if self.lost < 0 else Future()


def test_a_move_is_asked_for_again_where_its_answer_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ANSWER_SECONDS", "MATCHING_SECONDS"):
        monkeypatch.setattr(survey_client, name, 1.0)
    with fake_robot() as robot:
        node = rclpy.create_node("mission")
        client, walk = SurveyClient(node), Lossy(node, NavigateTo, "spot/navigate_to")
        walk.lost = MOST_TIMES_ASKED - 1
        assert client.drive(walk, NavigateTo.Goal(waypoint_id="dock"), 10.0).success
        walk.lost = MOST_TIMES_ASKED
        with pytest.raises(InputError, match="not answered"):
            client.drive(walk, NavigateTo.Goal(waypoint_id="gate"), 10.0)
        assert robot.said == ["walk dock"] * MOST_TIMES_ASKED + ["walk gate"] * MOST_TIMES_ASKED
        client.close()
