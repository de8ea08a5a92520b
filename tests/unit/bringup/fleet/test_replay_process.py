# SPDX-License-Identifier: Apache-2.0
"""The runner of a fleet with the real command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

pytest.importorskip("fsspec", reason="the packages of pipeprog fleet are not installed: make setup FLEET=1")

from pipeprog_bringup.fleet.recordings import Inputs, Recording
from pipeprog_bringup.fleet.replay_process import replay_and_report
from pipeprog_bringup.fleet.task import Refused, Task, Unwanted
from tests.unit.bringup.fleet.stand_ins import BOQ

ENDLESS = """
import contextlib, os, sys
from pathlib import Path
from pipeprog_bringup.fleet import replay_process
replay_process.own_cores = lambda count: contextlib.nullcontext(frozenset([max(os.sched_getaffinity(0))]))
replay_process._COMMAND = "tests.unit.bringup.fleet.endless"
from tests.unit.bringup.fleet.test_replay_process import task_of, Watching
replay_process.replay_and_report(task_of(Path(sys.argv[1])), Path(sys.argv[1]), Watching())
"""


class Watching:
    """Waits for `seconds`."""

    def __init__(self, seconds: float = 99.0) -> None:
        self._until = time.monotonic() + seconds

    def is_wanted(self) -> bool:
        return time.monotonic() < self._until

    def tell(self, state: dict[str, Any]) -> None:
        pass


def task_of(folder: Path) -> Task:
    (folder / "recording").mkdir(exist_ok=True)
    (folder / "recording/a.mcap").write_bytes(b"")
    (folder / "boq.yaml").write_text(BOQ)
    return Task(Recording("a", "s3://night/a.mcap", {}, Inputs()), ".yaml", BOQ.encode(), b"", "", "1", 1, 1000)


def test_what_replay_refuses_is_refused_by_its_words_and_the_recordings_address(tmp_path: Path) -> None:
    with pytest.raises(Refused) as refused:
        replay_and_report(task_of(tmp_path), tmp_path, Watching())
    assert refused.value.reason == "s3://night/a.mcap is empty (0 bytes): record or copy it again"
    assert "Error: recording/a.mcap is empty" in refused.value.log


def test_where_nobody_waits_the_command_is_ended(tmp_path: Path) -> None:
    with pytest.raises(Unwanted):
        replay_and_report(task_of(tmp_path), tmp_path, Watching(0.0))
    assert not [child for child in psutil.Process().children() if "replay" in child.cmdline()]


def test_the_command_has_the_cores_of_its_survey_and_ends_with_a_worker_that_is_killed(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, os.getcwd()])}
    with subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)], env=environment) as worker:
        while not (started := tmp_path / "started.json").exists():
            assert worker.poll() is None
            time.sleep(0.02)
        commands = psutil.Process(worker.pid).children()
        assert json.loads(started.read_text()) == {"cores": [max(os.sched_getaffinity(0))], "score": "1000"}
        os.kill(worker.pid, signal.SIGKILL)
    psutil.wait_procs(commands, timeout=10)
    assert not commands[0].is_running()
