# SPDX-License-Identifier: Apache-2.0
"""Loops over independent parts in all cores: most of a part is compiled, and lets the other threads run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")

# What a loop gives does not depend on it. Linux alone tells a process's cores.
THREADS = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 8)


def mapped(function: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """What the function gives of each part, in their order."""
    every = list(parts)
    if min(len(every), THREADS) < 2:
        return [function(part) for part in every]
    with ThreadPoolExecutor(min(len(every), THREADS)) as pool:
        return list(pool.map(function, every))
