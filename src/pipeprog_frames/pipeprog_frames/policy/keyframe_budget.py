# SPDX-License-Identifier: Apache-2.0
"""How many keyframes a map holds, of the most that it may: each takes memory in the SfM and the detector."""

from __future__ import annotations


class KeyframeBudget:
    """One for a map, whatever the number of cameras.

    Attributes:
        held: keyframes that were chosen and not retired.
    """

    def __init__(self, most: int) -> None:
        """`most`: keyframes that the map may hold; 0: any number."""
        self._most = most
        self.held = 0

    @property
    def is_full(self) -> bool:
        """Whether no further keyframe may be chosen."""
        return 0 < self._most <= self.held

    @property
    def load(self) -> float:
        """0 up to half of the limit, then rising to 1 at it: what is near the limit is thinned first."""
        return min(max(2.0 * self.held / self._most - 1.0, 0.0), 1.0) if self._most else 0.0
