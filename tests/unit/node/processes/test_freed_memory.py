# SPDX-License-Identifier: Apache-2.0
"""Freed memory, in a process of its own: how malloc keeps it cannot be taken back."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Prints the resident memory [MB] with 400 MB in use, when they are free, and the least within ten seconds.
PROGRAM = """
import os, time
import numpy as np
from pipeprog_node.processes.freed_memory import give_back_large_blocks, keep_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

{call}
np.ones(4_000_000)  # 32 MB: glibc's own limit of large blocks grows to that
arrays = [np.ones(500_000) for _ in range(100)]
last = np.ones(1_000_000)  # in use: what is free before it does not lie at the end of the heap
used = resident()
del arrays
free, deadline = resident(), time.monotonic() + {patience}
while (least := resident()) > used - 300.0 and time.monotonic() < deadline:
    time.sleep(0.01)
print(used, free, least)
"""


def memory(call: str, patience: float) -> list[float]:
    """MB in use, when free, and in the end."""
    program = PROGRAM.format(call=call, patience=patience)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    return [float(word) for word in done.stdout.split()]


def test_freed_memory_is_kept_for_what_comes_next() -> None:
    used, free, least = memory("keep_freed_memory(60.0)", patience=0.5)
    assert free > used - 100.0
    assert least > used - 100.0


def test_freed_memory_is_given_back_in_time() -> None:
    used, _, least = memory("keep_freed_memory(0.1)", patience=10.0)
    assert least <= used - 300.0


@pytest.mark.parametrize(("call", "kept"), [("", 300.0), ("give_back_large_blocks()", 0.0)], ids=["as it is", "a node"])
def test_large_blocks_are_given_back_at_once(call: str, kept: float) -> None:
    used, free, _ = memory(call, patience=0.0)
    assert free == pytest.approx(used - 400.0 + kept, abs=100.0)
