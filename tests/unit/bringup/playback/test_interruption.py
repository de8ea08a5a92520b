# SPDX-License-Identifier: Apache-2.0
"""Signals whose exception was lost are raised again."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

import pytest

from pipeprog_bringup.playback.interruption import repeated_signals


@pytest.fixture(autouse=True)
def python_handles_interrupts() -> Iterator[None]:
    """Also where the tests run in the background and a shell has SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_lost_in_a_callback_is_raised_again() -> None:
    with repeated_signals() as repeat:
        repeat()
        with contextlib.suppress(KeyboardInterrupt):  # as a destructor does
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            repeat()


def test_an_interrupt_is_raised_at_once_and_the_handlers_return() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), repeated_signals():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_an_ignored_signal_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with repeated_signals() as repeat:
        signal.raise_signal(signal.SIGINT)
        repeat()
