# SPDX-License-Identifier: Apache-2.0
"""A function in a process of its own, with limits of time and memory; what became of it, and of many files."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.survey import RESULTS, commit
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


def count_and_seed(description: str | None) -> argparse.Namespace:
    """The arguments of a benchmark that tries many files: `tried`, their number, and `seed`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tried", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def try_files(
    files: Iterable[Path],
    use: Callable[[Path], Any],
    judged: Callable[[Path, Outcome], str],
    seconds: float,
    memory: int,
) -> dict[str, Any]:
    """What became of each file, as numbers for a result; `judged` gives why an outcome is a failure, or ""."""
    failures, outcomes = [], []
    for path in files:
        outcome = run_limited(use, (path,), seconds, memory)
        outcomes.append(outcome)
        if reason := judged(path, outcome):
            failures.append({"name": path.name, "reason": reason})
            print(f"{path.name}: {reason}", flush=True)
    return {
        "tried": len(outcomes),
        "failed": len(failures),
        "refused": sum(outcome.kind == "refused" for outcome in outcomes),
        "failures": failures,
        "limits": {"seconds": seconds, "bytes": memory},
        "worst_seconds": round(max(outcome.seconds for outcome in outcomes), 1),
        "worst_bytes": max(outcome.memory for outcome in outcomes),
    }


def write_tried(name: str, what: str, arguments: argparse.Namespace, tried: dict[str, Any]) -> None:
    """Writes benchmarks/results/NAME.json of what `try_files` returned, and prints it without the single failures."""
    command = f"python -m benchmarks.{name} --tried {arguments.tried} --seed {arguments.seed}"
    document = {"what": what, "commit": commit(), "command": command, **tried}
    (RESULTS / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps({key: value for key, value in document.items() if key != "failures"}, indent=1))


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
