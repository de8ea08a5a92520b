# SPDX-License-Identifier: Apache-2.0
"""Models made one that share a keyframe."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import STEP, in_model, keyframe, matched, started

from pipeprog_sfm.features.retrieval import Retrieval
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.localizer import Localizer
from pipeprog_sfm.sparse.model_merging import merge, merge_models, similarity_between
from pipeprog_sfm.sparse.registration import add_view, locate
from pipeprog_sfm.sparse.sparse_map import SparseMap

TOLERANCE = 0.02  # of the base: 0.3 px of 300 points at 2 m are some 3 mm of a view's place


@pytest.mark.parametrize("swapped", [False, True])
def test_models_that_share_a_view_are_made_one(swapped: bool) -> None:
    """The view is in one of them and located in the other; it does not matter which of them is larger."""
    model, other = started(0, 1), started(2, 3)
    if swapped:
        fourth = keyframe(4)
        location = locate(other, fourth, {3 * STEP: matched(fourth, keyframe(3))}, seed=0)
        add_view(other, fourth, location, {n * STEP: keyframe(n) for n in (2, 3, 4)})
    location = locate(model, keyframe(2), {STEP: matched(keyframe(2), keyframe(1))}, seed=0)
    found = similarity_between(other, 0, model, location)
    assert found is not None
    assert found[0] == pytest.approx(1.0, abs=2 * TOLERANCE), "both have the same unit"
    smaller, larger = merge(other, model, *found)
    assert (smaller is model) == swapped
    assert sorted(larger.stamps) == [n * STEP for n in range(5 if swapped else 4)]
    centres = {stamp: larger.centre(view) for view, stamp in enumerate(larger.stamps)}
    first, second = (2, 3) if swapped else (0, 1)
    for stamp, place in centres.items():
        assert place == pytest.approx(in_model(first, second, stamp // STEP), abs=5 * TOLERANCE)


def test_a_view_without_a_place_relates_nothing() -> None:
    model, other = started(0, 1), started(16, 17)
    location = locate(model, keyframe(16), {STEP: matched(keyframe(16), keyframe(1))}, seed=0)
    assert similarity_between(other, 0, model, location) is None


def bent() -> SparseModel:
    """A model of two views most of whose points lie at wrong depths."""
    model = started(2, 3)
    centre = model.centre(0)
    wrong = np.random.default_rng(0).uniform(0.6, 1.6, len(model.points))
    wrong[::3] = 1.0
    model.points = centre + wrong[:, None] * (model.points - centre)
    return model


def test_a_model_that_contradicts_a_larger_one_is_given_up() -> None:
    """A third of its points agree: that alone would join the models, and leave two views in wrong places for ever."""
    straight, other = started(0, 1), bent()
    fourth = keyframe(4)
    location = locate(straight, fourth, {STEP: matched(fourth, keyframe(1))}, seed=0)
    add_view(straight, fourth, location, {n * STEP: keyframe(n) for n in (0, 1, 4)})
    sparse_map = SparseMap()
    sparse_map.keyframes = {n * STEP: keyframe(n) for n in range(5)}
    sparse_map.models = [other, straight]
    localizer = Localizer(sparse_map.keyframes, Retrieval(), seed=0)
    assert merge_models(sparse_map, localizer, 2 * STEP) == [2 * STEP, 3 * STEP]
    assert sparse_map.models == [straight]
    assert sparse_map.waiting == [2 * STEP, 3 * STEP]
