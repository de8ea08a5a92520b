# SPDX-License-Identifier: Apache-2.0
"""A connection that is read ahead."""

from __future__ import annotations

import threading
from multiprocessing import Pipe

import pytest

from pipeprog_sfm.inbox import Inbox


def test_commands_come_in_order_and_the_end_after_them() -> None:
    ours, theirs = Pipe()
    inbox = Inbox(theirs, lambda command: None)
    for number in range(5):
        ours.send(number)
    ours.close()
    assert inbox.poll(None)
    assert [inbox.recv() for _ in range(5)] == list(range(5))
    assert inbox.poll(None)  # that it is over
    with pytest.raises(EOFError):
        inbox.recv()


def test_what_comes_is_known_before_it_is_received() -> None:
    ours, theirs = Pipe()
    known, all_known = [], threading.Event()

    def on_arrival(command: int) -> None:
        known.append(command)
        if command == 2:
            all_known.set()

    inbox = Inbox(theirs, on_arrival)
    ours.send(1)
    ours.send(2)
    assert all_known.wait(timeout=10.0)
    assert known == [1, 2]
    assert inbox.recv() == 1


def test_nothing_comes_for_a_while() -> None:
    ours, theirs = Pipe()
    inbox = Inbox(theirs, lambda command: None)
    assert not inbox.poll(0.01)
    inbox.send("event")
    assert ours.recv() == "event"
