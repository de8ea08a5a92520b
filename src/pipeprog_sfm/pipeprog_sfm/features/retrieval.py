# SPDX-License-Identifier: Apache-2.0
"""Image retrieval: which of many keyframes show the same as a given one, by the number of matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import IntArray
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray, match

PAIRS_REMEMBERED = 2000  # pairs of keyframes whose matches are kept: 10 MB
SUBSET = 6  # views of a model that a keyframe is compared with at a time: the cost does not grow with the model
SIMILAR = 3  # of these that are then matched in full
PREVIEW = 400  # strongest features that such a comparison takes: a hundredth of the cost of all 4000
COARSE = 1500  # strongest features matched without a prediction of the pose: enough for one, a seventh of the cost


class Retrieval:
    """Matches of pairs of keyframes, each found once, and the search for keyframes that look alike.

    `match_pair` (as `match`) and `remembered` (pairs whose matches are kept) are given by tests only.
    """

    def __init__(
        self,
        match_pair: Callable[[NDArray[np.uint8], NDArray[np.uint8]], MatchArray] = match,
        remembered: int = PAIRS_REMEMBERED,
    ) -> None:
        self._match, self._remembered = match_pair, remembered
        self._matches: dict[tuple[int, int, int | None], MatchArray] = {}
        self._cursor = 0

    def matches(self, keyframe: Keyframe, other: Keyframe, count: int | None) -> MatchArray:
        """Matches of the `count` strongest features (None: of all) of two keyframes, found once."""
        pair = keyframe.stamp, other.stamp, count
        if pair not in self._matches:
            self._matches[pair] = self._match(keyframe.features.descriptors[:count], other.features.descriptors[:count])
            while len(self._matches) > self._remembered:
                del self._matches[next(iter(self._matches))]
        return self._matches[pair]

    def forget(self, stamp: int) -> None:
        """Drops the matches of a keyframe that gets other features."""
        self._matches = {pair: found for pair, found in self._matches.items() if stamp not in pair[:2]}

    def next_subset(self, count: int) -> IntArray:
        """Round-robin subset of `count` indices, evenly spaced; successive calls return different ones."""
        chosen = (self._cursor + np.arange(min(SUBSET, count)) * max(count // SUBSET, 1)) % count
        self._cursor += 1
        return chosen

    def most_similar(self, keyframe: Keyframe, others: Sequence[Keyframe], min_matches: int) -> IntArray:
        """Indices of up to SIMILAR others with most matches among the PREVIEW strongest features, the best first.

        Those with fewer than `min_matches` matches are left out.
        """
        found = np.array([len(self.matches(keyframe, other, PREVIEW)) for other in others], np.int64)
        order = np.argsort(-found, kind="stable")[:SIMILAR]
        return order[found[order] >= min_matches]
