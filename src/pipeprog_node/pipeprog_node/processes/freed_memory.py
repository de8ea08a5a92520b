# SPDX-License-Identifier: Apache-2.0
"""Memory that a worker has freed: kept for what it computes next, and given back to the system in time."""

from __future__ import annotations

import ctypes
import threading
import time

# glibc's malloc.h: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD [bytes], M_ARENA_MAX
_KEEP = ((-1, 1 << 30), (-3, 1 << 30), (-8, 1))
# Time [s] for which freed memory is kept at the most: several maps of a live survey, since what is given back has to be
# cleared anew when it is needed again (200 MB: 0.1 s, a hundredth of this time).
KEPT = 10.0


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
