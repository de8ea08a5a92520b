# SPDX-License-Identifier: Apache-2.0
"""A program as a child of a worker: `python -m pipeprog_bringup.fleet.child PARENT CORES PROGRAM ARGUMENTS...`.

It sets itself up, since a fork of a process with threads must do nothing before exec.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_FIRST_TO_GO = "1000"  # the highest oom_score_adj


def main() -> None:
    """Become PROGRAM, which ends with its worker, and before it where memory is short, and has the cores given.

    Its children inherit all but the first. PARENT is the worker's process number, CORES are numbers with commas.
    """
    parent, cores, *program = sys.argv[1:]
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # holds beyond exec
    if os.getppid() != int(parent):
        os._exit(1)
    os.sched_setaffinity(0, [int(core) for core in cores.split(",")])
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)
    os.execv(program[0], program)


if __name__ == "__main__":
    main()
