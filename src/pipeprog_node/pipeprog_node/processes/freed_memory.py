# SPDX-License-Identifier: Apache-2.0
"""Memory that a process has freed: a worker keeps it for what it computes next, a node gives it back."""

from __future__ import annotations

import ctypes
import threading
import time

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # glibc's malloc.h
_KEEP = ((_TRIM_THRESHOLD, 1 << 30), (_MMAP_THRESHOLD, 1 << 30), (_ARENA_MAX, 1))  # bytes, bytes, number
# Bytes from which on a block of a node has pages of its own. A cloud has tens of megabytes and comes every few seconds;
# JPEG images, ten and more a second, have less.
_LARGE = 1 << 20
# Time [s] for which freed memory is kept at the most: several maps of a live survey, since what is given back has to be
# cleared anew when it is needed again (200 MB: 0.1 s, a hundredth of this time).
KEPT = 10.0


def give_back_large_blocks() -> None:
    """Lets this process give back at once what it frees in large blocks, such as messages of clouds.

    glibc's own limit grows to the largest block freed so far (32 MiB at most). Blocks below it lie between small ones
    that are in use, and their pages stay (measured: 140 to 220 MB in each node that clouds pass through).
    """
    ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE)


def keep_freed_memory(kept: float = KEPT) -> None:
    """Lets this process use again what it frees, and gives back all `kept` seconds [s] what is free then.

    Arrays of 1 to 200 MB come and go: each one's pages, given back and cleared anew, would cost as much as filling them
    (measured: an eighth of a depth map's time). Kept for ever, they would hold what the largest map needed as long as
    the graph lives.
    """
    libc = ctypes.CDLL(None)
    for parameter, value in _KEEP:
        libc.mallopt(parameter, value)

    def give_back() -> None:
        while True:
            time.sleep(kept)
            libc.malloc_trim(0)

    threading.Thread(target=give_back, name="freed memory", daemon=True).start()
