# SPDX-License-Identifier: Apache-2.0
"""Counts of published and answered keyframes, on which lockstep and the load of the SfM rest."""

from __future__ import annotations

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


def test_reports_wait_until_they_are_asked_for() -> None:
    ledger = Ledger()
    for stamp in range(3):
        ledger.publish(stamp)
        ledger.receive(answer(stamp, stamp + 1))
    assert [report.stamp for reports in ledger.reports(2) for report in reports] == [0, 1]
    assert [report.stamp for reports in ledger.reports(2) for report in reports] == []
    assert [report.stamp for reports in ledger.reports(3) for report in reports] == [2]


def test_a_keyframe_that_was_lost_on_the_way_does_not_count_as_lag_for_ever() -> None:
    ledger = Ledger()
    for stamp in range(10):
        ledger.publish(stamp)
    ledger.receive(answer(9, 9))  # one of ten never arrived
    assert ledger.lag == 0
