# SPDX-License-Identifier: Apache-2.0
"""Loops in several threads give what a loop in one gives."""

from __future__ import annotations

import threading

import pytest

from pipeprog_detect import threads
from pipeprog_detect.threads import mapped


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
