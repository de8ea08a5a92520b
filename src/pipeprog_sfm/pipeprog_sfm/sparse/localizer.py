# SPDX-License-Identifier: Apache-2.0
"""Where a keyframe is in a model, by its matches with some of the model's views."""

from __future__ import annotations

from collections.abc import Mapping

from pipeprog_camera.arrays import IntArray
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray
from pipeprog_sfm.features.retrieval import Retrieval
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.registration import Location, locate


class Localizer:
    """Matches keyframes with views and solves for their poses; `keyframes` (by stamp) holds those of all views."""

    def __init__(self, keyframes: Mapping[int, Keyframe], retrieval: Retrieval, seed: int) -> None:
        self._keyframes = keyframes
        self._retrieval = retrieval
        self._seed = seed

    def locate(self, model: SparseModel, keyframe: Keyframe, matches: Mapping[int, MatchArray]) -> Location:
        """The keyframe's pose in a model by its matches with views of it, as from `matches`."""
        return locate(model, keyframe, matches, self._seed)

    def locate_by(self, model: SparseModel, keyframe: Keyframe, views: IntArray) -> Location:
        """The keyframe's pose in a model by all its matches with some views of it."""
        return self.locate(model, keyframe, self.matches(model, keyframe, views, None))

    def matches(
        self, model: SparseModel, keyframe: Keyframe, views: IntArray, count: int | None
    ) -> dict[int, MatchArray]:
        """By stamp of each of the views: matches of the `count` strongest features (None: of all)."""
        stamps = [model.stamps[view] for view in views]
        return {stamp: self._retrieval.matches(keyframe, self._keyframes[stamp], count) for stamp in stamps}

    def similar_views(self, model: SparseModel, keyframe: Keyframe, views: IntArray, min_matches: int = 1) -> IntArray:
        """Those of the views that share most of the strongest features with the keyframe, the best first."""
        others = [self._keyframes[model.stamps[view]] for view in views]
        return views[self._retrieval.most_similar(keyframe, others, min_matches)]

    def next_similar_views(self, model: SparseModel, keyframe: Keyframe) -> IntArray:
        """As `similar_views`, of the subset of the model's views whose turn it is."""
        return self.similar_views(model, keyframe, self.next_subset(len(model)))

    def next_subset(self, count: int) -> IntArray:
        """Which of `count` views are to be compared this time; successive calls return different ones."""
        return self._retrieval.next_subset(count)
