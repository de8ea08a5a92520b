# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM are neither lost nor mistaken for an error in C libraries."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MADE_BY_C = (RuntimeError, SystemError, TypeError)  # pybind11's, and CPython's where a C function fails unexpectedly


@contextlib.contextmanager
def repeated_signals() -> Iterator[Callable[[], None]]:
    """Notes the signals that arrive; yields a function that raises them again.

    What a signal's handler raises appears wherever the interpreter is at that moment. In a destructor, or in a callback
    that C code calls, it is printed and forgotten: who calls the function now and then ends nevertheless. Where C code
    makes Python objects, as rclpy does of a message's bytes, it ends as an error of that code, in whose place the
    signal is raised again. Signals that are ignored stay so, and outside the main thread, which gets no signals,
    nothing is noted.
    """
    caught: list[int] = []
    previous: dict[signal.Signals, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        previous[signal.Signals(number)](number, frame)

    def repeat() -> None:
        if caught:
            signal.raise_signal(caught[0])

    if threading.current_thread() is threading.main_thread():
        previous = {number: handler for number in _SIGNALS if callable(handler := signal.getsignal(number))}
        for number in previous:
            signal.signal(number, note)
    try:
        yield repeat
    except _MADE_BY_C:
        repeat()
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
