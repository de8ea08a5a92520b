# SPDX-License-Identifier: Apache-2.0
"""What the node `survey` writes down of a survey: how far it has come, pauses included."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from pipeprog_bringup.results.atomic_output import JOURNAL
from pipeprog_bringup.survey import sign_of_life
from pipeprog_bringup.survey.survey_journal import Progress, SurveyJournal, Unfinished, unfinished


def test_a_pause_is_not_filmed() -> None:
    progress = Progress(b"", filming=100.0)
    assert progress.filmed(130.0) == pytest.approx(30.0)
    progress.pause(130.0)
    progress.pause(140.0)  # asked for twice
    assert progress.is_paused
    assert progress.filmed(1000.0) == pytest.approx(30.0)
    progress.go_on(1030.0)
    progress.go_on(1040.0)
    assert not progress.is_paused
    assert progress.filmed(1050.0) == pytest.approx(50.0)


def test_a_pause_from_before_filming_takes_no_time_of_it() -> None:
    progress = Progress(b"")
    progress.pause(90.0)
    progress.filming = 100.0
    assert progress.filmed(500.0) <= 0.0
    progress.go_on(500.0)
    assert progress.filmed(520.0) == pytest.approx(20.0)


def test_a_pause_that_ends_before_filming_leaves_it_to_begin() -> None:
    progress = Progress(b"")
    progress.pause(90.0)
    progress.go_on(95.0)
    assert progress.filming == 0.0
    assert not progress.is_paused


def test_filming_that_is_over_is_not_paused() -> None:
    progress = Progress(b"", filming=100.0)
    progress.pause(130.0)
    progress.is_filmed = True
    assert not progress.is_paused


def test_a_survey_that_is_taken_up_is_paused_as_before(tmp_path: Path) -> None:
    killed = SurveyJournal(tmp_path, b"goal")
    killed.progress.filming = 100.0
    killed.progress.pause(130.0)
    killed.note()
    taken_up = SurveyJournal(tmp_path, b"goal").progress
    assert taken_up.is_paused
    assert taken_up.filmed(1000.0) == pytest.approx(30.0)


def test_a_survey_goes_on_though_the_clock_was_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed = tmp_path / "monday" / ".pipeprog-killed"
    (killed / JOURNAL).mkdir(parents=True)
    SurveyJournal(killed / JOURNAL, b"goal").close()
    now, since_start = time.time(), sign_of_life._now()
    monkeypatch.setattr(time, "time", lambda: now + 7200.0)
    assert unfinished(tmp_path) == Unfinished(killed, b"goal")
    monkeypatch.setattr(sign_of_life, "_now", lambda: since_start + 120.0)
    assert unfinished(tmp_path) is None  # the robot is elsewhere
