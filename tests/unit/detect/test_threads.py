# SPDX-License-Identifier: Apache-2.0
"""Loops in several threads give what a loop in one gives."""

from __future__ import annotations

import itertools
import threading

import pytest

from pipeprog_detect import threads
from pipeprog_detect.threads import beside, mapped


@pytest.mark.parametrize("cores", [1, 3])
def test_results_keep_the_order_of_the_parts(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the number of threads nor which of them is done first shows."""
    monkeypatch.setattr(threads, "THREADS", cores)
    assert mapped(lambda part: part * part, range(50)) == [part * part for part in range(50)]
    assert mapped(str, iter(())) == []


def test_parts_are_worked_on_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two parts meet at a barrier, which one thread alone never passes."""
    monkeypatch.setattr(threads, "THREADS", 2)
    barrier = threading.Barrier(2, timeout=30.0)
    assert sorted(mapped(lambda _: barrier.wait(), range(2))) == [0, 1]


def test_a_part_that_fails_ends_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its own error."""
    monkeypatch.setattr(threads, "THREADS", 2)
    with pytest.raises(ZeroDivisionError):
        mapped(lambda part: 1 // part, [1, 0, 2])


def test_parts_are_worked_on_beside_the_block_and_no_longer() -> None:
    """The block waits for the first of parts without end."""
    first = threading.Event()
    done: list[int] = []

    def work(part: int) -> None:
        done.append(part)
        first.set()

    with beside(work, itertools.count()):
        assert first.wait(30.0)
    assert done == list(range(len(done))) != []


def test_what_fails_beside_a_block_fails_at_its_end() -> None:
    reached = False
    with pytest.raises(ZeroDivisionError), beside(lambda part: 1 // part, [0]):
        reached = True
    assert reached


def test_a_block_that_fails_beside_others_fails_with_its_own_error() -> None:
    with pytest.raises(KeyError), beside(lambda part: 1 // part, [0]):
        raise KeyError
