# SPDX-License-Identifier: Apache-2.0
"""A third keyframe registered in a model of two."""

from __future__ import annotations

import pytest
from scenes import CAMERA, STEP, blurred, centre, in_model, keyframe, matched, started

from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.sparse.registration import add_view, locate, rejection_reason

TOLERANCE = 0.02  # of the base: 0.3 px of 300 points at 2 m are some 3 mm of a view's place


def test_a_third_view_is_located_and_entered_where_it_is() -> None:
    model, third = started(0, 1), keyframe(2)
    matches = {STEP: matched(third, keyframe(1))}
    location = locate(model, third, matches, seed=0)
    assert location.camera_from_model is not None
    assert centre(location.camera_from_model) == pytest.approx(in_model(0, 1, 2), abs=2 * TOLERANCE)
    view = add_view(model, third, location, {n * STEP: keyframe(n) for n in range(3)})
    assert model.centre(view) == pytest.approx(in_model(0, 1, 2), abs=2 * TOLERANCE)
    assert len(model.seen(view)) > len(location.pairs), "views that look at the same place are matched as well"
    assert rejection_reason(model, view, matches) == ""


def test_a_view_of_elsewhere_has_no_place_and_says_why() -> None:
    model, strange = started(0, 1), keyframe(16)
    location = locate(model, strange, {STEP: matched(strange, keyframe(1))}, seed=0)
    assert location.camera_from_model is None
    assert "matches agree on a pose" in location.reason


def test_a_pose_that_its_matches_contradict_is_objected_to() -> None:
    model, third = started(0, 1), keyframe(2)
    matches = {STEP: matched(third, keyframe(1))}
    view = add_view(model, third, locate(model, third, matches, seed=0), {n * STEP: keyframe(n) for n in range(3)})
    model.translation[view] += [0.0, 0.5, 0.0]
    assert "agree with its pose" in rejection_reason(model, view, matches)
    model.point_of[model.features(view)] = -1
    assert rejection_reason(model, view, matches) == "only 0 points hold its pose"


def test_features_somewhere_else_tell_no_pose() -> None:
    model, third = started(0, 1), Keyframe.of(2 * STEP, blurred(keyframe(2).features, 10), CAMERA)
    assert locate(model, third, {STEP: matched(third, keyframe(1))}, seed=0).camera_from_model is None
