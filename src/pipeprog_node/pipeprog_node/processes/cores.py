# SPDX-License-Identifier: Apache-2.0
"""The processor cores that a node may use, with the processes and threads that it starts."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable


def limit_cores(cores: int, warn: Callable[[str], object]) -> None:
    """Has this process use `cores` of those that it may use, the first of them; 0: all.

    Processes and pools of threads that are started later inherit the limit. Where there are fewer cores, all are used,
    and `warn` is told.
    """
    allowed = sorted(os.sched_getaffinity(0))
    if cores > len(allowed):
        warn(f"cores = {cores}: this process may use {len(allowed)}, and uses them all; 0 asks for all")
    if not 0 < cores < len(allowed):
        return
    for thread in os.listdir("/proc/self/task"):  # the middleware and BLAS have started some
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), allowed[:cores])
