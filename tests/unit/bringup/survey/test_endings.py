# SPDX-License-Identifier: Apache-2.0
"""How surveys end without their client's asking, and what is left then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from mcap.reader import make_reader

from pipeprog_bringup.survey import conducted_survey, survey_output
from pipeprog_bringup.survey import node as survey_node
from pipeprog_bringup.survey.survey_output import MIN_FREE
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import SiteProgress
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from pipeprog_sfm.alignment.map_file import MAP_FILE, write_map
from tests.unit.bringup.survey.fake_graph import MAP
from tests.unit.bringup.survey.survey_stage import SurveyStage


class Disk:
    """Stands for shutil in the module that writes: `free` bytes of every disk."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free = MIN_FREE
        monkeypatch.setattr(survey_output, "shutil", SimpleNamespace(disk_usage=lambda path: self))


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_a_survey_for_which_the_disk_has_no_room_does_not_begin(
    surveys: SurveyStage, disk: Disk, tmp_path: Path
) -> None:
    surveys.activate()
    disk.free = MIN_FREE - 1
    answer = surveys.result(surveys.send(survey_id="full"))
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == Survey.Result.BAD_INPUT
    folder = tmp_path / "surveys" / "full"
    assert answer.result.error_msg == (
        f"less than 1 GiB is free for {folder}: make room, or change the parameter results"
    )
    assert not folder.exists()
    assert surveys.graph.asked == []  # no node has begun


def test_filming_ends_early_where_the_disk_gets_full_and_keeps_what_was_measured(
    surveys: SurveyStage, disk: Disk
) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="filled")
    surveys.let_finish(keyframes=1, revision=1)
    disk.free = MIN_FREE - 1
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_SUCCEEDED, Survey.Result.NO_SPACE)
    assert answer.result.error_msg.startswith("filming ended early: less than 1 GiB is free for ")
    assert "make room" in answer.result.error_msg
    assert [pipe.id for pipe in answer.result.pipes.pipes] == ["p01"]
    assert (Path(answer.result.folder) / "pipes.json").is_file()


@pytest.mark.parametrize(
    ("is_cancelled", "status", "code"),
    [
        (True, GoalStatus.STATUS_CANCELED, Survey.Result.NONE),
        (False, GoalStatus.STATUS_ABORTED, Survey.Result.NO_IMAGES),
    ],
)
def test_a_survey_without_an_image_is_answered_though_its_folder_is_gone(
    surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_cancelled: bool, status: int, code: int
) -> None:
    monkeypatch.setattr(conducted_survey, "ROOM_PERIOD", 0.0)  # s: whenever it waits, for the nodes' rest, too
    surveys.activate()
    handle = surveys.film(survey_id="nothing")
    if is_cancelled:
        surveys.cancel(handle)
    else:
        surveys.let_finish(keyframes=0, revision=0)
        surveys.end()
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_code) == (status, code)
    assert answer.result.folder == ""
    assert not (tmp_path / "surveys" / "nothing").exists()


def test_a_fault_of_the_program_is_told_and_the_next_survey_can_begin(
    surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise ZeroDivisionError("nothing to divide by")

    surveys.activate()
    with monkeypatch.context() as during:
        during.setattr(conducted_survey, "advice", fails)
        answer = surveys.result(surveys.send(survey_id="faulty"))
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, Survey.Result.UNKNOWN)
    assert "ZeroDivisionError: nothing to divide by" in answer.result.error_msg
    surveys.cancel(surveys.film(survey_id="faulty"))  # the name is free again: nothing was filmed


def test_a_fault_of_the_program_keeps_what_was_filmed(surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path, *_: object) -> None:
        path.write_text("half of a table")
        raise ZeroDivisionError("nothing to divide by")

    surveys.activate()
    handle = surveys.film_a_map(survey_id="faulty")
    surveys.let_finish(keyframes=1, revision=1)
    monkeypatch.setattr(survey_output.result_files, "write_config", fails)
    surveys.end()
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, Survey.Result.UNKNOWN)
    folder = Path(answer.result.folder)
    assert [file.name for file in folder.iterdir()] == ["out.mcap"]
    with (folder / "out.mcap").open("rb") as stream:
        topics = {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert "/keyframes/image/compressed" in topics


def test_filming_ends_after_its_time_limit(surveys: SurveyStage) -> None:
    surveys.activate()
    surveys.let_finish(keyframes=1, revision=1)
    handle = surveys.send(survey_id="limited", time_limit=Duration(sec=1))
    surveys.until(lambda: surveys.graph.is_heard)
    surveys.graph.add_keyframe(True)
    surveys.graph.publish_map(1)
    answer = surveys.result(handle)  # nobody has called the service end
    assert (answer.status, answer.result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, "")
    assert messages.seconds(answer.result.total_elapsed_time) >= 1.0
    assert [pipe.id for pipe in answer.result.pipes.pipes] == ["p01"]


@pytest.fixture
def monday(tmp_path: Path) -> str:
    """The name of an earlier survey."""
    earlier = tmp_path / "surveys" / "monday"
    earlier.mkdir(parents=True)
    write_map(earlier / MAP_FILE, MAP)
    return earlier.name


def test_a_survey_whose_reference_is_not_found_again_keeps_its_pipes(surveys: SurveyStage, monday: str) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="tuesday", reference=monday)
    surveys.graph.map = MAP  # in a frame of its own
    surveys.graph.report(metric=True, message="no keyframe shows a place of the reference")
    surveys.until(lambda: surveys.feedback[-1].advice)
    surveys.let_finish(keyframes=1, revision=1)
    surveys.end()
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_SUCCEEDED, Survey.Result.NOT_ALIGNED)
    assert answer.result.error_msg == "no keyframe shows a place of the reference"
    assert [pipe.id for pipe in answer.result.pipes.pipes] == ["p01"]
    assert not answer.result.reference_covariance.any()
    assert (Path(answer.result.folder) / "pipes.json").is_file()


def test_a_survey_with_a_reference_whose_last_map_could_not_be_measured_has_failed(
    surveys: SurveyStage, monday: str
) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="tuesday", reference=monday)
    surveys.let_finish(keyframes=1, revision=2)
    surveys.graph.answers["detect"][0] = Finish.Response(message="the last map could not be measured")
    surveys.end()
    answer = surveys.result(handle)
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, Survey.Result.UNKNOWN)
    assert "the last map could not be measured" in answer.result.error_msg
    assert "the pipes are in a frame of their own" in answer.result.error_msg


@pytest.fixture
def told(surveys: SurveyStage, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """The surveys of which it was told what has changed between them, as the robot hears it."""
    heard: list[tuple[str, str]] = []
    surveys.robot.create_subscription(
        SiteProgress, "progress", lambda message: heard.append((message.earlier, message.later)), qos.latched()
    )
    monkeypatch.setattr(
        survey_node,
        "site_progress",
        lambda earlier, later, header: SiteProgress(header=header, earlier=earlier.name, later=later.name),
    )
    return heard


@pytest.mark.parametrize("is_full", [False, True])
def test_what_has_changed_since_the_reference_is_told_of_each_survey_that_is_aligned(
    surveys: SurveyStage, disk: Disk, monday: str, told: list[tuple[str, str]], is_full: bool
) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="tuesday", reference=monday)
    covariance = np.diag([4e-6] * 3 + [1e-8] * 3 + [1e-9])
    surveys.graph.map = replace(MAP, aligned_by="places", alignment_covariance=covariance)
    surveys.let_finish(keyframes=1, revision=1)
    if is_full:
        disk.free = MIN_FREE - 1
    else:
        surveys.end()
    answer = surveys.result(handle)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.error_code == (Survey.Result.NO_SPACE if is_full else Survey.Result.NONE)
    surveys.until(lambda: told)
    assert told == [("monday", "tuesday")]
