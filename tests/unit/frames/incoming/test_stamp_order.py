# SPDX-License-Identifier: Apache-2.0
"""Which stamps continue a sequence: absurd ones, clocks that are set, repetitions."""

from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from pipeprog_frames.incoming.stamp_order import AGREEING, MAX_GAP, StampOrder

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def placed(stamps: Iterable[int]) -> tuple[list[int], dict[int, str], list[int]]:
    """Positions taken, reasons by position, and positions at which the sequence begins anew."""
    order: StampOrder[int] = StampOrder()
    taken: list[int] = []
    reasons: dict[int, str] = {}
    anew: list[int] = []
    for position, stamp in enumerate(stamps):
        place = order.place(stamp, position)
        reasons.update(place.refused)
        taken += place.taken
        anew += place.taken[:1] if place.anew else []
    reasons.update(order.flush())
    return taken, reasons, anew


def good(count: int, start: int = START) -> list[int]:
    return [start + index * SECOND // 10 for index in range(count)]


def test_one_absurd_stamp_costs_one_image() -> None:
    stamps = good(10)
    for absurd, reason in ((START + 10**6 * SECOND, "stamp jumps ahead"), (1, "stamp runs backwards")):
        taken, reasons, anew = placed([*stamps[:5], absurd, *stamps[5:]])
        assert taken == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10]
        assert reasons == {5: reason}
        assert not anew


def test_an_absurd_stamp_at_the_very_start_costs_one_image() -> None:
    taken, reasons, anew = placed([START + 10**6 * SECOND, *good(5)])
    assert taken == [0, 1, 2, 3, 4, 5]
    assert not reasons
    assert anew == [1]


def test_a_clock_that_is_set_costs_no_image() -> None:
    for step in (-5 * SECOND, -(10**6) * SECOND, 2 * MAX_GAP):
        taken, reasons, anew = placed([*good(4), *good(4, START + step)])
        assert taken == list(range(8))
        assert not reasons
        assert anew == [4]


def test_absurd_stamps_in_a_row_agree_with_one_another_before_they_are_taken() -> None:
    absurd = [START + 10**6 * SECOND, 5, START + 10**8 * SECOND, 3, 2, 1]
    taken, reasons, _ = placed([*good(4), *absurd, *good(4, START + SECOND)])
    assert taken == [0, 1, 2, 3, 10, 11, 12, 13]
    assert sorted(reasons) == [4, 5, 6, 7, 8, 9]


def test_fewer_than_agree_are_refused_at_the_end() -> None:
    taken, reasons, _ = placed([*good(3), *good(AGREEING - 1, 1)])
    assert taken == [0, 1, 2]
    assert set(reasons.values()) == {"stamp runs backwards"}


def test_a_repeated_stamp_is_named() -> None:
    taken, reasons, _ = placed([10, 10, 20, 5, 5, 30])
    assert taken == [0, 2, 5]
    assert reasons == {1: "stamp repeats", 3: "stamp runs backwards", 4: "stamp repeats"}


@given(st.lists(st.integers(0, 2**31 * SECOND)))
def test_each_image_is_taken_or_refused_once(stamps: list[int]) -> None:
    taken, reasons, _ = placed(stamps)
    assert sorted([*taken, *reasons]) == list(range(len(stamps)))
