# SPDX-License-Identifier: Apache-2.0
"""The memory that a survey will take, foreseen from its recording."""

from __future__ import annotations

_BASE = 1200  # MB; four processes with their libraries, and the maps of the smallest survey
_PER_BYTE = 60  # of memory for each byte of a recording of JPEG images; benchmarks/fleet.py measures it
_SAFETY = 1.2  # over what an earlier run of the same recording took: settings may differ


def foreseen(size: int, earlier: int | None) -> int:
    """Peak of all processes of a survey [MB] of a recording of `size` bytes; `earlier` is what it once took [MB]."""
    return round(_SAFETY * earlier) if earlier else round(_BASE + _PER_BYTE * size / 1e6)
