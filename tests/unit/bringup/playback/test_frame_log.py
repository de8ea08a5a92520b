# SPDX-License-Identifier: Apache-2.0
"""The log of a live survey says whether the camera has a place in the map."""

from __future__ import annotations

import pytest

from pipeprog_bringup.playback.frame_log import LOST_AFTER, FrameLog, LiveFrameLog
from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_frames.frame_decision import FULL


def log_of(*registered: bool | None) -> LiveFrameLog:
    """The log after keyframes with a place, without one, or (None) not worked off yet."""
    log = LiveFrameLog()
    for stamp, has_place in enumerate(registered):
        log.decide(FrameRow(stamp, True, "overlap"))
        if has_place is not None:
            log.overlap(stamp, 0.5, 0.5, 100, has_place)
    return log


@pytest.mark.parametrize(
    ("registered", "is_tracking"),
    [
        ([], True),
        ([False] * (LOST_AFTER - 1), True),
        ([False] * LOST_AFTER, False),
        ([True] + [False] * LOST_AFTER, False),
        ([True] + [False] * (LOST_AFTER - 1), True),
        ([False] * LOST_AFTER + [None], True),
        ([False] * LOST_AFTER + [True], True),
    ],
)
def test_tracking_is_lost_where_none_of_the_last_keyframes_has_a_place(
    registered: list[bool | None], is_tracking: bool
) -> None:
    assert log_of(*registered).is_tracking == is_tracking


def test_tracking_returns_with_a_keyframe_that_gets_its_place_later() -> None:
    log = log_of(*[False] * LOST_AFTER)
    log.overlap(LOST_AFTER - 1, 0.5, 0.5, 100, True)
    assert log.is_tracking


def test_frames_that_are_not_chosen_and_repeated_decisions_do_not_count_as_keyframes() -> None:
    log = log_of(*[False] * (LOST_AFTER - 1))
    log.decide(FrameRow(0, True, "published again"))
    log.decide(FrameRow(99, False, "blurred"))
    assert log.is_tracking
    assert (log.considered, log.chosen) == (LOST_AFTER, LOST_AFTER - 1)


def test_a_decision_that_replaces_another_is_counted_in_its_place() -> None:
    log = FrameLog()
    for stamp in (1, 2):
        log.play(stamp)
    log.skip(3, "damaged message")
    for row in (FrameRow(1, True, "overlap"), FrameRow(2, False, FULL), FrameRow(1, False, FULL)):
        log.decide(row)
    assert (log.chosen, log.beyond_limit) == (0, 2)
    log.decide(FrameRow(2, True, "overlap"))
    assert (log.chosen, log.beyond_limit) == (1, 1)
    assert [row.chosen for row in log.rows()] == [False, True, False]
