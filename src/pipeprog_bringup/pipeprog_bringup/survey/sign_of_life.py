# SPDX-License-Identifier: Apache-2.0
"""That a process has lived until a moment ago, told to the one that is started in its place, whatever the clock says.

A robot's clock is set when it finds its time server, by hours at times, so signs are of the time since the start of the
computer.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

_ALIVE = 60.0  # s since the last sign of life, in which a supervisor starts a node anew; later the robot is elsewhere
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def sign(file: Path) -> None:
    """Notes in a file that this process lives, due every few seconds; raises OSError."""
    text = f"{_boot()} {_now():016.3f}"
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT, 0o600), "w") as stream:
        stream.write(text)  # always as long and in one piece, so that no kill leaves half of it


def is_alive(file: Path) -> bool:
    """Whether a process signed this file a moment ago, and since this computer was started."""
    try:
        boot, signed = file.read_text().split()
        return boot == _boot() and abs(_now() - float(signed)) <= _ALIVE  # signs are rounded, up or down
    except (OSError, ValueError):  # none, or a file that is no sign
        return False


def _boot() -> str:
    """What tells one start of the computer from another."""
    return _BOOT_ID.read_text().strip()


def _now() -> float:
    """Seconds since the computer was started, sleep included."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
