# SPDX-License-Identifier: Apache-2.0
"""Cores of a machine for one survey alone, so that surveys beside each other do not take turns on the same ones."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

from dask.system import CPU_COUNT


@contextlib.contextmanager
def own_cores(count: int) -> Iterator[frozenset[int]]:
    """`count` cores of this process's that no other survey on this machine holds, for as long as the context lasts.

    All cores of this process where fewer are free, and where a quota of CPU time (a container's) is less than its
    cores: the machine's other containers cannot be seen from inside.
    """
    cores = sorted(os.sched_getaffinity(0))
    with contextlib.ExitStack() as locks:
        held: list[int] = []
        if len(cores) <= CPU_COUNT:
            for core in cores:
                if len(held) < count and (lock := _lock(core)):
                    locks.enter_context(lock)
                    held.append(core)
        if len(held) < count:
            locks.close()
        yield frozenset(held if len(held) == count else cores)


def _lock(core: int) -> socket.socket | None:
    """What holds a core; None where another process does. Its abstract name is gone with the process."""
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        lock.bind(f"\0pipeprog-core-{core}")
    except OSError:
        lock.close()
        return None
    return lock
