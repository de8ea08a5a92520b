# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM are not lost in callbacks of C libraries."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def repeated_signals() -> Iterator[Callable[[], None]]:
    """Notes the signals that arrive; yields a function that raises them again.

    What a signal's handler raises appears wherever the interpreter is at that moment: in a destructor, or in a callback
    that C code calls, it is printed and forgotten. Who calls the function now and then ends nevertheless. Signals that
    are ignored stay so, and outside the main thread, which gets no signals, nothing is noted.
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
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
