# SPDX-License-Identifier: Apache-2.0
"""The processor cores of this process."""

import os


def usable_cores() -> int:
    """How many this process may use; where only Linux could tell, all that the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
