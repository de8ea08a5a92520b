# SPDX-License-Identifier: Apache-2.0
"""A function in a process of its own, with limits of time and memory; what became of it."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError


@dataclass(frozen=True)
class Outcome:
    """What became of a call: "done", "refused" (an InputError), or why it failed."""

    kind: str
    text: str
    seconds: float
    memory: int  # bytes resident at most, what the parent had before it included


def run_limited(function: Callable[..., Any], arguments: tuple[Any, ...], seconds: float, memory: int) -> Outcome:
    """Calls it in a fork of this process, which may take `seconds` and `memory` bytes beyond those at its start."""
    context = multiprocessing.get_context("fork")  # the parent has imported and compiled everything
    receiver, sender = context.Pipe(duplex=False)
    started = time.monotonic()
    process = context.Process(target=_child, args=(sender, function, arguments, memory))
    process.start()
    sender.close()
    told = receiver.poll(seconds)
    if not told:
        process.kill()
    try:
        kind, text = receiver.recv() if told else ("too slow", f"over {seconds:.0f} s")
    except EOFError:
        kind, text = "ended", ""
    assert process.pid is not None  # started
    _, status, usage = os.wait4(process.pid, 0)
    if kind == "ended":
        code = os.waitstatus_to_exitcode(status)
        text = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    elapsed, peak = time.monotonic() - started, usage.ru_maxrss * 1024
    if kind in ("done", "refused") and peak > memory:
        kind, text = "too large", f"{peak} bytes"
    return Outcome(kind, text, elapsed, peak)


def _child(sender: Connection, function: Callable[..., Any], arguments: tuple[Any, ...], memory: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        function(*arguments)
        sender.send(("done", ""))
    except InputError as error:
        sender.send(("refused", str(error)))
    except BaseException:  # that is what is looked for
        sender.send(("traceback", traceback.format_exc().strip()[-500:]))
