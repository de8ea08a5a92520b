# SPDX-License-Identifier: Apache-2.0
"""A connection that is read in a thread of its own: what comes is known while earlier commands are worked off."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any


class Inbox:
    """The receiving side of a connection, with the same methods.

    Args:
        connection: from which commands come and to which events go.
        on_arrival: called with each command, in the thread that reads; before the command can be received.
    """

    def __init__(self, connection: Connection, on_arrival: Callable[[Any], None]) -> None:
        self._connection, self._on_arrival = connection, on_arrival
        self._arrived: deque[Any] = deque()
        self._is_closed = False
        self._changed = threading.Condition()
        threading.Thread(target=self._read, name="inbox", daemon=True).start()

    def poll(self, timeout: float | None) -> bool:
        """Waits for a command, or the end, for `timeout` seconds or, with None, for ever; whether it has come."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: self._arrived or self._is_closed, timeout))

    def recv(self) -> Any:
        """Takes the next command; raises EOFError when the other end is closed and none is left."""
        self.poll(None)
        if not self._arrived:
            raise EOFError
        return self._arrived.popleft()

    def send(self, event: Any) -> None:
        """Sends an event."""
        self._connection.send(event)

    def _read(self) -> None:
        try:
            while True:
                command = self._connection.recv()
                self._on_arrival(command)
                with self._changed:
                    self._arrived.append(command)
                    self._changed.notify_all()
        except (EOFError, OSError):
            pass
        finally:
            with self._changed:
                self._is_closed = True
                self._changed.notify_all()
