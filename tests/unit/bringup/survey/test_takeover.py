# SPDX-License-Identifier: Apache-2.0
"""What a node `survey` leaves for the next one."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup.survey import sign_of_life
from pipeprog_bringup.survey.takeover import Takeover
from pipeprog_msgs.action import Survey

NAME = "/spot/survey"


def left_by_one_that_was_killed(results: Path, is_written: bool = True) -> None:
    """An active node that has kept the answer to its survey `monday`."""
    killed = Takeover(results, NAME)
    assert not killed.was_active
    killed.sign()
    killed.keep(Survey.Result(folder=str(results / "monday"), error_msg="as it was"))
    if is_written:
        (results / "monday").mkdir()
        (results / "monday" / "run.json").touch()


def test_an_answer_that_was_not_given_is_given_by_the_next_node(tmp_path: Path) -> None:
    left_by_one_that_was_killed(tmp_path)
    after = Takeover(tmp_path, NAME)
    assert after.was_active
    answer = after.answer_to(Survey.Goal(survey_id="monday"))
    assert answer is not None
    assert answer.error_msg == "as it was"
    assert after.answer_to(Survey.Goal(survey_id="tuesday")) is None
    after.keep(Survey.Result(folder=str(tmp_path / "tuesday")))
    assert after.answer_to(Survey.Goal(survey_id="monday")) is None  # a later survey was answered


def test_a_survey_whose_files_have_no_names_yet_has_no_answer(tmp_path: Path) -> None:
    left_by_one_that_was_killed(tmp_path, is_written=False)
    assert Takeover(tmp_path, NAME).answer_to(Survey.Goal(survey_id="monday")) is None


def test_another_node_of_the_same_folder_takes_nothing_over(tmp_path: Path) -> None:
    left_by_one_that_was_killed(tmp_path)
    other = Takeover(tmp_path, "/other/survey")
    assert not other.was_active
    assert other.answer_to(Survey.Goal(survey_id="monday")) is None


def test_a_node_that_was_ended_or_is_long_gone_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long_ago = sign_of_life._now() - 3600.0
    monkeypatch.setattr(sign_of_life, "_now", lambda: long_ago)
    left_by_one_that_was_killed(tmp_path)
    monkeypatch.undo()
    assert not Takeover(tmp_path, NAME).was_active
    one = Takeover(tmp_path, NAME)
    one.sign()
    one.end()
    assert not Takeover(tmp_path, NAME).was_active


@pytest.mark.parametrize("content", [b"", b"\0", b"\xff" * 1000, b"\0\1\0\0" + b"\xff" * 64])
def test_a_file_that_is_no_answer_is_passed_over(tmp_path: Path, content: bytes) -> None:
    left_by_one_that_was_killed(tmp_path)
    (tmp_path / ".spot.survey" / "answer.cdr").write_bytes(content)
    assert Takeover(tmp_path, NAME).answer_to(Survey.Goal(survey_id="monday")) is None


def test_a_folder_that_cannot_be_written_ends_nothing(tmp_path: Path) -> None:
    (tmp_path / "surveys").touch()
    one = Takeover(tmp_path / "surveys", NAME)
    one.sign()
    one.keep(Survey.Result())
    one.end()
    assert not Takeover(tmp_path / "surveys", NAME).was_active
