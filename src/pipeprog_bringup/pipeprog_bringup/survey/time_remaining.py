# SPDX-License-Identifier: Apache-2.0
"""How long the work after filming still takes, by its pace so far."""

from __future__ import annotations

import math

_LEAST = 0.01  # share of the work that tells a pace; a smaller one is a single keyframe, which may take any time


class TimeRemaining:
    """Extrapolates the progress of work; times in s of one clock.

    The progress moves in steps, and the pace is known at a step: between two steps the estimate counts down.
    """

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None  # time and progress when the work began
        self._progress = math.nan
        self._end = -math.inf  # when the work is expected to be done

    def at(self, now: float, progress: float) -> float:
        """Seconds that remain at the time `now`, with this share [0, 1] of the work done; NaN: it has not begun.

        0: not known, because too little was done since the work began, or because it takes longer than expected.
        """
        if math.isnan(progress):
            return 0.0
        if self._first is None:
            self._first, self._progress = (now, progress), progress
        began, first = self._first
        if progress > self._progress and progress - first >= _LEAST:
            self._progress = progress
            self._end = began + (now - began) * (1.0 - first) / (progress - first)
        return max(self._end - now, 0.0)
