# SPDX-License-Identifier: Apache-2.0
"""The processor cores of this process."""

import os


def usable_cores() -> int:
    """How many this process may use: those that the system leaves it, and no more than OMP_NUM_THREADS says.

    Without Linux, which alone tells a process's cores, they are those of the machine.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get("OMP_NUM_THREADS", "")  # of libraries, which a fleet of surveys on one machine sets
    return min(cores, max(int(asked), 1)) if asked.isdecimal() else cores
