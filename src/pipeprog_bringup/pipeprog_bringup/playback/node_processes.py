# SPDX-License-Identifier: Apache-2.0
"""The three nodes as processes of one replay: started, watched and ended together."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import yaml

from pipeprog_camera.errors import InputError

NODE_MODULES = {"frames": "pipeprog_frames.node", "sfm": "pipeprog_sfm.node", "detect": "pipeprog_detect.node"}
SHARED_MEMORY = "/dev/shm"
_SHARED_BYTES = 65536  # LTTng, which rclpy loads, takes two pages; more for the locks of Python's child processes
_STOP_SECONDS = 3.0
_PR_SET_PDEATHSIG = 1
_FALLOC_FL_KEEP_SIZE = 1
LOG_ROOM = 1 << 16  # bytes; a node says a few lines in a replay, a traceback has 4000 bytes
_LIBC = ctypes.CDLL(None) if os.name == "posix" else None  # no graph runs elsewhere, but the command loads


class NodeFailure(Exception):
    """A node died, fell silent or could not do its work: the text names it."""


def require_ros() -> None:
    """Raises InputError where this Python cannot import ROS 2 or pipeprog's messages; the text says what is needed."""
    _require_shared_memory()
    for name in ("rclpy", "pipeprog_msgs.msg"):
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                f"a replay runs ROS 2 nodes, and this Python cannot import {name} ({error}): run `make setup` in "
                "pipeprog's repository and use .venv/bin/pipeprog, or source the setup.bash of a workspace in which "
                "pipeprog is built; the other commands work without ROS"
            ) from None


def _require_shared_memory() -> None:
    """Raises InputError where /dev/shm is full: on importing rclpy, the kernel would end the process (SIGBUS)."""
    try:
        with tempfile.TemporaryFile(dir=SHARED_MEMORY) as file:
            file.write(bytes(_SHARED_BYTES))
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # without the folder, or permission, ROS does without
            raise InputError(
                f"{SHARED_MEMORY} is full, and ROS 2 and Python keep a few pages there: remove files of programs that "
                f"have ended (`ls -l {SHARED_MEMORY}`), or give the container more of it (docker run --shm-size)"
            ) from None


class Graph:
    """Context in which the nodes run; at its end they and their child processes are ended.

    `parameters` are flat ROS parameters per node; `folder` takes the parameter files and the nodes' output. Each node
    leads a process group of its own, so that Ctrl-C reaches only the command, which then ends the nodes in order.
    Should the command itself be killed, the kernel ends the nodes.
    """

    def __init__(
        self,
        parameters: Mapping[str, Mapping[str, Any]],
        folder: Path,
        modules: Mapping[str, str] = NODE_MODULES,
    ) -> None:
        self._parameters, self._folder, self._modules = parameters, folder, modules
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Graph:
        try:
            for name in self._modules:
                self._start(name)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def check(self) -> None:
        """Raise NodeFailure when a node has ended."""
        for name, process in self._processes.items():
            ended = os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            if ended is None:
                continue
            if ended.si_code == os.CLD_EXITED:
                how = f"stopped with exit code {ended.si_status}"
            else:
                how = f"was killed by {signal.Signals(ended.si_status).name}"
            raise NodeFailure(f"the node {name} (process {process.pid}) {how}{self._last_error(name)}")

    def stop(self) -> None:
        """End every node and its children: asked first, killed after a few seconds."""
        for process in self._processes.values():
            self._signal(process, signal.SIGINT)
        deadline = time.monotonic() + _STOP_SECONDS
        while time.monotonic() < deadline and not all(self._has_ended(p) for p in self._processes.values()):
            time.sleep(0.02)
        for process in self._processes.values():
            # The group outlives its leader while a worker runs; not yet waited for, its number cannot be reused.
            self._signal(process, signal.SIGKILL)
            process.wait()
        self._processes.clear()

    def _start(self, name: str) -> None:
        parameters = {key: value for key, value in self._parameters.get(name, {}).items() if value is not None}
        file = self._folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump({name: {"ros__parameters": parameters}}))
        arguments = ["--ros-args", "-r", f"__node:={name}", "--params-file", str(file)]
        command = [sys.executable, "-m", self._modules[name], *arguments]
        with self._log(name).open("wb") as log:
            _set_room_aside(log)
            self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
                preexec_fn=_prepare,
            )

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _last_error(self, name: str) -> str:
        """The error that the node's last traceback ends with, or the last line of its output; where all of it is."""
        lines = [line.strip() for line in self._log(name).read_text(errors="replace").splitlines() if line.strip()]
        errors = [line for line in lines if re.match(r"([\w.]+(Error|Exception|Interrupt)|error): ", line)]
        if not lines:
            return ""
        return f": {(errors or lines)[-1]}\nIts whole output: {self._log(name)}"

    @staticmethod
    def _has_ended(process: subprocess.Popen[bytes]) -> bool:
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    @staticmethod
    def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)


def _set_room_aside(log: BinaryIO) -> None:
    """Takes LOG_ROOM of the disk for a file without changing its length, where the file system can do so.

    The images of a recording may fill the disk that the logs are on, and the node must still say so.
    """
    assert _LIBC is not None
    _LIBC.fallocate(log.fileno(), _FALLOC_FL_KEEP_SIZE, ctypes.c_int64(0), ctypes.c_int64(LOG_ROOM))


def _prepare() -> None:
    """In the new process: its own group, in the session of the command, and it dies with its parent.

    One session, as under `ros2 launch`: Linux gives each the same share of the processors (autogroups, sched(7)).
    """
    assert _LIBC is not None
    os.setpgid(0, 0)
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
