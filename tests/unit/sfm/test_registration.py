"""Two views start a model, a third is registered in it, two such models are made one: each step against the truth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, STEP, blurred, centre, pose, view

from pipeprog_sfm.initialisation import model_of_pair
from pipeprog_sfm.keyframe import Keyframe
from pipeprog_sfm.matching import match
from pipeprog_sfm.merging import merge, relation
from pipeprog_sfm.model import SparseModel
from pipeprog_sfm.registration import enter, locate, objection

BASE = 0.25  # m between two views, the unit of a model that they start
TOLERANCE = 0.02  # of the base: 0.3 px of 300 points at 2 m are some 3 mm of a view's place


@lru_cache
def keyframe(n: int) -> Keyframe:
    return Keyframe.of(n * STEP, view(pose(BASE * n), n), CAMERA)


def matched(one: Keyframe, other: Keyframe) -> NDArray[np.int32]:
    return match(one.features.descriptors, other.features.descriptors)


def started(first: int, second: int) -> SparseModel:
    one, other = keyframe(first), keyframe(second)
    model = model_of_pair(one, other, matched(one, other), seed=0)
    assert model is not None
    return model


def in_model(first: int, second: int, n: int) -> NDArray[np.float64]:
    """True centre of view n in the model that two others have started."""
    origin, unit = pose(BASE * first), np.linalg.norm(centre(pose(BASE * first)) - centre(pose(BASE * second)))
    return (origin[:3, :3] @ centre(pose(BASE * n)) + origin[:3, 3]) / unit


def test_two_views_are_a_model_whose_unit_is_their_distance() -> None:
    model = started(0, 1)
    assert model.stamps == [0, STEP]
    assert (model.pose(0) == np.eye(4)).all()
    assert model.centre(1) == pytest.approx(in_model(0, 1, 1), abs=TOLERANCE)


def test_two_views_from_one_place_are_no_model() -> None:
    one, other = (Keyframe.of(n * STEP, view(pose(0.0, 0.1 * n), n), CAMERA) for n in range(2))
    assert len(matched(one, other)) > 100
    assert model_of_pair(one, other, matched(one, other), seed=0) is None


def test_a_third_view_is_located_and_entered_where_it_is() -> None:
    model, third = started(0, 1), keyframe(2)
    matches = {STEP: matched(third, keyframe(1))}
    location = locate(model, third, matches, seed=0)
    assert location.camera_from_model is not None
    assert centre(location.camera_from_model) == pytest.approx(in_model(0, 1, 2), abs=2 * TOLERANCE)
    view = enter(model, third, location, {n * STEP: keyframe(n) for n in range(3)})
    assert model.centre(view) == pytest.approx(in_model(0, 1, 2), abs=2 * TOLERANCE)
    assert len(model.seen(view)) > len(location.pairs), "views that look at the same place are matched as well"
    assert objection(model, view, matches) == ""


def test_a_view_of_elsewhere_has_no_place_and_says_why() -> None:
    model, strange = started(0, 1), keyframe(16)
    location = locate(model, strange, {STEP: matched(strange, keyframe(1))}, seed=0)
    assert location.camera_from_model is None
    assert "matches agree on a pose" in location.reason


def test_a_pose_that_its_matches_contradict_is_objected_to() -> None:
    model, third = started(0, 1), keyframe(2)
    matches = {STEP: matched(third, keyframe(1))}
    view = enter(model, third, locate(model, third, matches, seed=0), {n * STEP: keyframe(n) for n in range(3)})
    model.translation[view] += [0.0, 0.5, 0.0]
    assert "agree with its pose" in objection(model, view, matches)
    model.point_of[model.features(view)] = -1
    assert objection(model, view, matches) == "only 0 points hold its pose"


def test_features_somewhere_else_tell_no_pose() -> None:
    model, third = started(0, 1), Keyframe.of(2 * STEP, blurred(keyframe(2).features, 10), CAMERA)
    assert locate(model, third, {STEP: matched(third, keyframe(1))}, seed=0).camera_from_model is None


@pytest.mark.parametrize("swapped", [False, True])
def test_models_that_share_a_view_are_made_one(swapped: bool) -> None:
    """The view is in one of them and located in the other; it does not matter which of them is larger."""
    model, other = started(0, 1), started(2, 3)
    if swapped:
        fourth = keyframe(4)
        location = locate(other, fourth, {3 * STEP: matched(fourth, keyframe(3))}, seed=0)
        enter(other, fourth, location, {n * STEP: keyframe(n) for n in (2, 3, 4)})
    location = locate(model, keyframe(2), {STEP: matched(keyframe(2), keyframe(1))}, seed=0)
    found = relation(other, 0, model, location)
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
    assert relation(other, 0, model, location) is None
