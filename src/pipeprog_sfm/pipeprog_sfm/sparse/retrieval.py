"""Keyframes that show the same: their matches, found once, and those out of many that look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.arrays import IntArray
from pipeprog_sfm.sparse.keyframe import Keyframe
from pipeprog_sfm.sparse.matching import MatchArray, match

PAIRS_REMEMBERED = 2000  # of keyframes, whose matches are kept: 10 MB
RETRIEVED = 6  # views of a model that a lost keyframe is compared with, others each time: the cost stays bounded
ALIKE = 3  # of these that are matched in full
GLANCE = 400  # features that such a comparison takes


class Retrieval:
    """Matches of pairs of keyframes, and the views that look like a keyframe."""

    def __init__(self) -> None:
        self._matches: dict[tuple[int, int, int | None], MatchArray] = {}
        self._cursor = 0

    def matches(self, keyframe: Keyframe, other: Keyframe, count: int | None) -> MatchArray:
        """Matches of the `count` strongest features (None: of all) of two keyframes, found once."""
        pair = keyframe.stamp, other.stamp, count
        if pair not in self._matches:
            self._matches[pair] = match(keyframe.features.descriptors[:count], other.features.descriptors[:count])
            while len(self._matches) > PAIRS_REMEMBERED:
                del self._matches[next(iter(self._matches))]
        return self._matches[pair]

    def forget(self, stamp: int) -> None:
        """A keyframe that gets other features is matched anew."""
        self._matches = {pair: found for pair, found in self._matches.items() if stamp not in pair[:2]}

    def turn(self, count: int) -> IntArray:
        """The few out of `count` that it is the turn of, spread evenly; others each time."""
        chosen = (self._cursor + np.arange(min(RETRIEVED, count)) * max(count // RETRIEVED, 1)) % count
        self._cursor += 1
        return chosen

    def resembling(self, keyframe: Keyframe, others: Sequence[Keyframe], least: int) -> IntArray:
        """Which of the others share most of the strongest features, and at least so many; the best first."""
        found = np.array([len(self.matches(keyframe, other, GLANCE)) for other in others], np.int64)
        order = np.argsort(-found, kind="stable")[:ALIKE]
        return order[found[order] >= least]
