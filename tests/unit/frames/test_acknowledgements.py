# SPDX-License-Identifier: Apache-2.0
"""Counts of published and answered keyframes, on which lockstep and the load of the SfM rest."""

from __future__ import annotations

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_frames.acknowledgements import MAX_AHEAD, Answer, Ledger
from pipeprog_frames.overlap_feedback import OverlapReport


def answer(stamp: int, keyframes: int, retirements: int = 0) -> Answer:
    return Answer(stamp, keyframes, retirements, (OverlapReport(stamp, True, 0.9, 0.9, 100, 100),))


def test_the_next_keyframe_waits_for_the_answer_to_the_one_before_the_last() -> None:
    ledger = Ledger()
    for stamp in range(MAX_AHEAD):
        assert ledger.may_publish
        ledger.publish(stamp)
    assert not ledger.may_publish
    ledger.receive(answer(0, 1))
    assert ledger.may_publish
    assert not ledger.is_answered


def test_nothing_is_published_while_a_retirement_is_unanswered() -> None:
    ledger = Ledger()
    ledger.publish(0)
    ledger.receive(answer(0, 1))
    ledger.retire()
    assert not ledger.may_publish
    ledger.receive(answer(0, 1, 1))
    assert ledger.may_publish
    assert ledger.is_answered


def test_answers_wait_until_they_are_asked_for() -> None:
    ledger = Ledger()
    for stamp in range(3):
        ledger.publish(stamp)
        ledger.receive(answer(stamp, stamp + 1))
    assert [report.stamp for each in ledger.answers(2) for report in each.reports] == [0, 1]
    assert [report.stamp for each in ledger.answers(2) for report in each.reports] == []
    assert [report.stamp for each in ledger.answers(3) for report in each.reports] == [2]


def test_a_keyframe_that_was_lost_on_the_way_does_not_count_as_lag_for_ever() -> None:
    ledger = Ledger()
    for stamp in range(10):
        ledger.publish(stamp)
    ledger.receive(answer(9, 9))  # one of ten never arrived
    assert ledger.lag == 0


def test_an_answer_that_the_sfm_of_a_replay_cannot_have_given_is_refused() -> None:
    ledger = Ledger(exact=True)
    for stamp in range(2):
        ledger.publish(stamp)
    with pytest.raises(InputError, match="an answer to 3 keyframes and 0 retirements, of which 2 and 0"):
        ledger.receive(answer(0, 3))
    with pytest.raises(InputError, match="does another graph run"):
        ledger.receive(answer(0, 1, 1))
    ledger.receive(answer(0, 1))
    for _ in range(20_000):
        with pytest.raises(InputError, match="a second answer to 1 keyframes"):
            ledger.receive(answer(0, 1))
    assert len(list(ledger.answers(2))) == 1


def test_live_the_sfm_may_have_worked_for_others_before() -> None:
    ledger = Ledger()
    ledger.publish(0)
    ledger.receive(answer(7, 500))
    assert len(list(ledger.answers(500))) == 1
