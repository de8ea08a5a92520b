# SPDX-License-Identifier: Apache-2.0
"""Signals whose exception was lost are raised again."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

import builtin_interfaces.msg
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

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


def test_an_interrupt_that_c_code_has_made_an_error_of_is_raised_again() -> None:
    """A message is made of its bytes by C code, which makes objects of Python classes."""

    class Time(builtin_interfaces.msg.Time):
        def __init__(self) -> None:
            signal.raise_signal(signal.SIGINT)
            super().__init__()

    data = serialize_message(Header())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtin_interfaces.msg._time.Time", Time)
        with pytest.raises(KeyboardInterrupt), repeated_signals():
            deserialize_message(data, Header)


def test_an_error_without_a_signal_stays_one() -> None:
    with pytest.raises(TypeError, match="of its own"), repeated_signals():
        raise TypeError("of its own")


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
