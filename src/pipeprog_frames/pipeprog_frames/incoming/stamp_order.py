# SPDX-License-Identifier: Apache-2.0
"""Which images continue the sequence, by their stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

MAX_GAP = 3_600_000_000_000  # ns; an hour: a longer pause is none between two images of a walk
AGREEING = 3  # outliers in a row that are no accident: two wrong stamps follow one another by chance now and then

Item = TypeVar("Item")


@dataclass(frozen=True)
class Placed(Generic[Item]):
    """What a stamp decides: items refused with the reason, items taken in order, and whether these begin anew."""

    refused: list[tuple[Item, str]]
    taken: list[Item]
    anew: bool = False


class StampOrder(Generic[Item]):
    """Takes the items whose stamps continue the sequence.

    A stamp continues it if it is later than the last by no more than MAX_GAP. Any other is an outlier, and its item is
    held: it is refused as soon as an item continues the sequence, or an outlier does not continue it. Where AGREEING
    outliers in a row continue one another, the clock was set: they are all taken, and the sequence goes on from them.
    So one absurd stamp does not have the good ones after it refused, and no item is lost at a new clock.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._held: list[tuple[int, Item]] = []

    def place(self, stamp: int, item: Item) -> Placed[Item]:
        """Takes the next item, with its stamp in ns."""
        newest = self._held[-1][0] if self._held else None
        if stamp in (self._last, newest):
            return Placed([(item, "stamp repeats")], [])
        if self._last is None or _continues(self._last, stamp):
            refused = self.flush()
            self._last = stamp
            return Placed(refused, [item])
        refused = [] if newest is None or _continues(newest, stamp) else self.flush()
        self._held.append((stamp, item))
        if len(self._held) < AGREEING:
            return Placed(refused, [])
        taken = [held for _, held in self._held]
        self._held.clear()
        self._last = stamp
        return Placed(refused, taken, anew=True)

    def flush(self) -> list[tuple[Item, str]]:
        """Refuses what is held."""
        last = self._last or 0
        refused = [
            (item, "stamp runs backwards" if stamp < last else "stamp jumps ahead") for stamp, item in self._held
        ]
        self._held.clear()
        return refused


def _continues(before: int, after: int) -> bool:
    return 0 < after - before <= MAX_GAP
