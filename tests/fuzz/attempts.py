# SPDX-License-Identifier: Apache-2.0
"""Attempts on one target in a process of their own, which a hang, a crash or too much memory may end."""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import random
import resource
import signal
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError

MAX_SECONDS = 20.0  # s for one input; real time, so that waiting counts, too
MAX_BYTES = 2 << 30  # of address space, beside what Python and its libraries take
BATCH = 200  # inputs from one seed, between two reports
SHRINKING = 10.0  # s to make a failing input smaller


@dataclass(frozen=True)
class Target:
    """A reader: `make` gives an input from one random stream, `read` reads the file that holds it."""

    name: str
    suffix: str
    make: Callable[[random.Random], bytes]
    read: Callable[[Path], object]


@dataclass
class Outcome:
    """What became of the inputs of a target; failures by what went wrong, each with the file that repeats it."""

    tried: int = 0
    worst_seconds: float = 0.0
    worst_bytes: int = 0  # resident, with Python and its libraries
    failures: dict[str, Path] = field(default_factory=dict)

    def add(self, other: Outcome) -> None:
        """Takes the inputs of `other` in."""
        self.tried += other.tried
        self.worst_seconds = max(self.worst_seconds, other.worst_seconds)
        self.worst_bytes = max(self.worst_bytes, other.worst_bytes)
        self.failures = other.failures | self.failures


def fuzz(target: Target, seed: int, seconds: float, kept: Path) -> Outcome:
    """Tries inputs of a target for a time [s]; what fails is kept in the folder `kept`."""
    until = time.monotonic() + seconds
    outcome, batch = Outcome(), 0
    with tempfile.TemporaryDirectory() as folder:
        while batch == 0 or time.monotonic() < until:
            current = Path(folder) / f"input{target.suffix}"
            with _child(_attempts, target, seed, batch, until, current, kept) as (process, events):
                for done in events:
                    outcome.add(done)
                    batch += 1
            if process.exitcode:
                outcome.tried += 1
                outcome.failures.setdefault(_end(process.exitcode), _keep(target.name, current, kept))
            batch += 1
    return outcome


def read_limited(target: Target, path: Path) -> str:
    """Reads one file in a process within the limits; what went wrong, empty where nothing did."""
    with _child(_one_attempt, target, path) as (process, events):
        said = list(events)
    return said[0] if said else _end(process.exitcode or 0)


@contextlib.contextmanager
def _child(
    work: Callable[..., None], *arguments: Any
) -> Iterator[tuple[multiprocessing.process.BaseProcess, Iterator]]:
    """A process that runs work(connection, ...), and what it sends until it ends."""
    context = multiprocessing.get_context("spawn")
    parent, child = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(child, *arguments))
    process.start()
    child.close()
    yield process, _received(parent)
    process.join()


def _received(connection: Connection) -> Iterator:
    with contextlib.suppress(EOFError):
        while True:
            yield connection.recv()


def _end(exit_code: int) -> str:
    if exit_code == -signal.SIGALRM:
        return f"took over {MAX_SECONDS:.0f} s"
    return f"ended the process: {signal.Signals(-exit_code).name if exit_code < 0 else f'exit code {exit_code}'}"


def _keep(name: str, current: Path, kept: Path) -> Path:
    data = current.read_bytes()
    kept.mkdir(parents=True, exist_ok=True)
    path = kept / f"{name.replace(' ', '_')}-{hashlib.sha256(data).hexdigest()[:8]}{current.suffix}"
    path.write_bytes(data)
    return path


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    bound = pages * resource.getpagesize() + MAX_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))


def _read(target: Target, path: Path) -> str:
    """What goes wrong as a target reads a file, with the place; empty where nothing does."""
    signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS)  # SIGALRM ends a process, wherever it is
    try:
        target.read(path)
    except InputError:
        pass
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "pipeprog" in frame.filename] or frames
        return f"{type(error).__name__} at {Path(ours[-1].filename).name}:{ours[-1].lineno}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return ""


def _one_attempt(connection: Connection, target: Target, path: Path) -> None:
    _limit_memory()
    connection.send(_read(target, path))


def _attempts(
    connection: Connection, target: Target, seed: int, batch: int, until: float, current: Path, kept: Path
) -> None:
    # What decoders write about damaged input is of no use, but the last words of a process that crashes are.
    with current.with_suffix(".log").open("w") as log:
        os.dup2(log.fileno(), 2)
    _limit_memory()
    known: set[str] = set()
    while True:
        outcome = Outcome()
        rng = random.Random(f"{target.name} {seed} {batch}")
        for _ in range(BATCH):
            outcome.add(_attempt(target, target.make(rng), current, kept, known))
        outcome.worst_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        connection.send(outcome)
        batch += 1
        if time.monotonic() > until:
            return


def _attempt(target: Target, data: bytes, current: Path, kept: Path, known: set[str]) -> Outcome:
    """One input; where it fails in a way that is not known yet, as few of its bytes as fail so are kept."""
    current.write_bytes(data)
    started = time.perf_counter()
    problem = _read(target, current)
    outcome = Outcome(tried=1, worst_seconds=time.perf_counter() - started)
    if problem and _place(problem) not in known:
        known.add(_place(problem))
        current.write_bytes(_shrunk(target, data, _place(problem), current))
        outcome.failures[problem] = _keep(target.name, current, kept)
    return outcome


def _shrunk(target: Target, data: bytes, place: str, current: Path) -> bytes:
    """The bytes without those pieces, of half their length down to one, without which the same goes wrong."""
    until = time.monotonic() + SHRINKING
    length = len(data)
    while length := length // 2:
        at = 0
        while at < len(data) and time.monotonic() < until:
            shorter = data[:at] + data[at + length :]
            current.write_bytes(shorter)
            if _place(_read(target, current)) == place:
                data = shorter
            else:
                at += length
    return data


def _place(problem: str) -> str:
    """Type of an exception and where it was raised, without its words."""
    return problem.partition(": ")[0]
