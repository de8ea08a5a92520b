# SPDX-License-Identifier: Apache-2.0
"""A folder locked by one process; the kernel gives up the locks of a process that ends."""

from __future__ import annotations

import os
import sys
from pathlib import Path

if sys.platform == "win32":

    def locked(folder: Path) -> int:
        """-1: Windows locks no folders."""
        return -1

else:
    import fcntl

    def locked(folder: Path) -> int:
        """Descriptor that holds a folder locked until it is closed; BlockingIOError where another process holds it."""
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor
