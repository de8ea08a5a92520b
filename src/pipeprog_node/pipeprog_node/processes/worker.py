# SPDX-License-Identifier: Apache-2.0
"""A child process for a node's heavy work, so that callbacks only enqueue and the node keeps answering."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from rclpy.node import Node

from pipeprog_node.processes.freed_memory import keep_freed_memory

_PR_SET_PDEATHSIG = 1


class WorkerProcess:
    """Runs `serve(connection, *arguments)` in a child process and hands its events to the node's executor.

    `serve` is a module-level function that answers what it receives with events on the same connection until the
    connection closes. `on_event(event)` and `on_death(exit code)` run in the executor's thread.
    """

    def __init__(
        self,
        node: Node,
        serve: Callable[..., None],
        arguments: tuple[Any, ...],
        on_event: Callable[[Any], None],
        on_death: Callable[[int], None],
    ) -> None:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the child: on small matrices BLAS threads only spin
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Numba's threads: what waits must leave the core to others
        context = multiprocessing.get_context("spawn")  # fork would copy the middleware's threads half alive
        self._connection, child = context.Pipe()
        self._process = context.Process(target=_child_main, args=(child, serve, arguments), daemon=True)
        self._process.start()
        child.close()
        self._on_event, self._on_death = on_event, on_death
        self._events: deque[Any] = deque()
        self._outbox: deque[Any] = deque()
        self._ready = threading.Condition()
        self._closing = False
        self._guard = node.create_guard_condition(self._deliver)
        threading.Thread(target=self._read, name="worker events", daemon=True).start()
        threading.Thread(target=self._write, name="worker commands", daemon=True).start()

    def send(self, command: Any) -> None:
        """Queues a picklable command; never blocks."""
        with self._ready:
            self._outbox.append(command)
            self._ready.notify()

    @property
    def backlog(self) -> int:
        """Commands that the child has not taken yet."""
        return len(self._outbox)

    def close(self) -> None:
        """Ends the child, now: what it has not finished is lost."""
        self._closing = True
        self._process.kill()  # rather than SIGTERM, at which some libraries print a stack trace
        self._process.join(timeout=2.0)

    def _write(self) -> None:
        while not self._closing:
            with self._ready:
                self._ready.wait_for(lambda: self._outbox, timeout=1.0)
                if not self._outbox:
                    continue
                command = self._outbox[0]
            try:
                self._connection.send(command)
            except OSError:
                return  # _read reports the death
            with self._ready:
                self._outbox.popleft()

    def _read(self) -> None:
        while True:
            try:
                event = self._connection.recv()
            except (EOFError, OSError):
                break
            self._events.append(event)
            self._guard.trigger()
        self._process.join()
        if not self._closing:
            self._events.append(_Death(self._process.exitcode or 0))
            self._guard.trigger()

    def _deliver(self) -> None:
        while self._events:
            event = self._events.popleft()
            if isinstance(event, _Death):
                self._on_death(event.exit_code)
            else:
                self._on_event(event)


class _Death:
    def __init__(self, exit_code: int) -> None:
        self.exit_code = exit_code


def _child_main(connection: Connection, serve: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    # The kernel ends the child with its parent, however that dies; Ctrl-C is the parent's to handle.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, BrokenPipeError):  # the parent is gone
        serve(connection, *arguments)
