# SPDX-License-Identifier: Apache-2.0
"""A process that may use one core alone does not count the others."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pipeprog_camera.cores import usable_cores

ONE = """
import os
os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
from pipeprog_camera.cores import usable_cores
print(usable_cores())
"""


def test_cores_are_those_that_the_process_may_use() -> None:
    told = subprocess.run([sys.executable, "-c", ONE], check=True, capture_output=True, text=True).stdout
    assert int(told) == 1


@pytest.mark.parametrize(("asked", "expected"), [("2", 2), ("0", 1), ("64", 6), ("", 6), ("2,1", 6), ("-1", 6)])
def test_an_environment_may_leave_fewer(asked: str, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert usable_cores() == expected


def test_the_machine_counts_where_a_process_has_none_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert usable_cores() == 6
