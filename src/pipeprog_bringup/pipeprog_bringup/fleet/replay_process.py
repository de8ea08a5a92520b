# SPDX-License-Identifier: Apache-2.0
"""`pipeprog replay` and `pipeprog report` as a child process of a worker: watched, and ended with it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from pipeprog_bringup.fleet.cores import own_cores
from pipeprog_bringup.fleet.task import Refused, SurveyFailure, Task, Unwanted, Watcher
from pipeprog_camera.outside_text import for_terminal

_POLL_SECONDS = 0.25  # between two looks at the process
_TELL_SECONDS = 1.0  # between two messages to who waits
_WEIGH_SECONDS = 2.0  # between two looks at its memory, which take 10 ms
_STOP_SECONDS = 8.0  # in which a replay ends its nodes, 3 s each way
_USAGE = 2  # exit status of the command: wrong options
_CHILD, _COMMAND = "pipeprog_bringup.fleet.child", "pipeprog_bringup.cli"


def replay_and_report(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
    """The runner of a fleet: the recording in `folder` through the node graph, and the page about it.

    Returns `replay_s`, `report_s` and `peak_mb`, the memory of all processes of the replay at most.
    """
    recording = next((folder / "recording").iterdir()).relative_to(folder)
    board = ["--board", "board.yaml"] if task.board else []
    inputs = task.recording.inputs
    options = [part for text in inputs.settings for part in ("--set", text)]
    options += [part for key, topic in inputs.topics.items() for part in (f"--{key.replace('_', '-')}", topic)]
    started = time.monotonic()
    arguments = ["replay", str(recording), "--boq", f"boq{task.boq_kind}", *board, "--out", "results", *options]
    with own_cores(task.cores) as cores:
        with _Command(arguments, task, folder, cores) as replay:
            replay.follow(watcher)
        replayed = time.monotonic()
        with _Command(["report", "results", "--out", "results/report.html"], task, folder, cores) as report:
            report.follow(watcher)
    return {
        "replay_s": round(replayed - started, 3),
        "report_s": round(time.monotonic() - replayed, 3),
        "peak_mb": replay.peak_mb,
    }


class _Command:
    """Context in which a command of pipeprog runs in `folder`, on `cores` alone; at its end all its processes end."""

    def __init__(self, arguments: list[str], task: Task, folder: Path, cores: frozenset[int]) -> None:
        self._name, self._folder, self._log = arguments[0], folder, folder / "replay.log"
        self._state = folder / "state.json"
        self._state.unlink(missing_ok=True)
        if self._name == "replay":
            arguments = [*arguments, "--progress", self._state.name]
        temporary = folder / "tmp"
        temporary.mkdir(exist_ok=True)
        self._environment = {**os.environ, **_threads(task.cores), "TMPDIR": str(temporary), "PYTHONUNBUFFERED": "1"}
        self._arguments, self._cores = arguments, ",".join(map(str, sorted(cores)))
        self._recording, self._uri = arguments[1], task.recording.uri
        self.peak_mb = 0

    def __enter__(self) -> _Command:
        python = [sys.executable, "-m"]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [*python, _CHILD, str(os.getpid()), self._cores, *python, _COMMAND, *self._arguments],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_STOP_SECONDS)
        if self._process.poll() is None:
            self._signal(signal.SIGKILL)
            self._process.wait()

    def follow(self, watcher: Watcher) -> None:
        """Wait until the command is done; raises Refused, SurveyFailure or Unwanted."""
        told = weighed = 0.0
        while (code := self._process.poll()) is None:
            if not watcher.is_wanted():
                raise Unwanted
            now = time.monotonic()
            if now > told + _TELL_SECONDS:
                told = now
                watcher.tell({"stage": self._name, **self._read_state(), "log": self._words()})
            if now > weighed + _WEIGH_SECONDS:
                weighed = now
                self.peak_mb = max(self.peak_mb, _megabytes(self._process.pid))
            time.sleep(_POLL_SECONDS)
        if code == 0:
            return
        log = self._log.read_text(errors="replace")
        if code == _USAGE or (code == 1 and self._read_state().get("failed") == "InputError"):
            raise Refused(_reason(log).replace(self._recording, self._uri), log)
        how = f"exit status {code}" if code > 0 else f"killed by {signal.Signals(-code).name}"
        raise SurveyFailure(f"pipeprog {self._name}, {how}: {_reason(log)}", log)

    def _read_state(self) -> dict[str, Any]:
        try:
            state: dict[str, Any] = json.loads(self._state.read_text())
        except (OSError, ValueError):
            return {}
        return state

    def _words(self) -> str:
        return self._log.read_text(errors="replace")[-4096:]  # all that a replay says but for a node's traceback

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)


def _threads(cores: int) -> dict[str, str]:
    """Environment that gives the libraries of a process, and its own loops, `cores` threads."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    return dict.fromkeys(names, str(cores))


def _megabytes(pid: int) -> int:
    """Memory of a process and its children: what each has of its own, and the largest share in common."""
    own, common = 0, 0
    with contextlib.suppress(psutil.Error):
        parent = psutil.Process(pid)
        for process in (parent, *parent.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                memory = process.memory_info()
                own += memory.rss - memory.shared
                common = max(common, memory.shared)
    return round((own + common) / 1e6)


def _reason(log: str) -> str:
    """The error that a command ended with, its last line without the word before it."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("Error: ")]
    return for_terminal((errors or lines or ["it said nothing"])[-1].removeprefix("Error: "))
