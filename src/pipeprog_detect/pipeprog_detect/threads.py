# SPDX-License-Identifier: Apache-2.0
"""Loops over independent parts in all cores: most of a part is compiled, and lets the other threads run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from pipeprog_camera.cores import usable_cores

Part = TypeVar("Part")
Result = TypeVar("Result")

# What a loop gives does not depend on it.
THREADS = min(usable_cores(), 8)


def mapped(function: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """What the function gives of each part, in their order."""
    every = list(parts)
    if min(len(every), THREADS) < 2:
        return [function(part) for part in every]
    with ThreadPoolExecutor(min(len(every), THREADS)) as pool:
        return list(pool.map(function, every))


@contextmanager
def beside(function: Callable[[Part], object], parts: Iterable[Part]) -> Iterator[None]:
    """Works on parts in another thread while the block lasts; those that are not begun by its end are left out.

    What fails there fails at the end of the block.
    """
    is_over = threading.Event()

    def work() -> None:
        for part in parts:
            if is_over.is_set():
                return
            function(part)

    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        try:
            yield
        finally:
            is_over.set()
    working.result()
