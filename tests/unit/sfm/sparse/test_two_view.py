# SPDX-License-Identifier: Apache-2.0
"""Models of two keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CAMERA, STEP, in_model, matched, pose, started, view

from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.sparse.two_view import model_from_pair

TOLERANCE = 0.02  # of the base: 0.3 px of 300 points at 2 m are some 3 mm of a view's place


def test_two_views_are_a_model_whose_unit_is_their_distance() -> None:
    model = started(0, 1)
    assert model.stamps == [0, STEP]
    assert (model.pose(0) == np.eye(4)).all()
    assert model.centre(1) == pytest.approx(in_model(0, 1, 1), abs=TOLERANCE)


def test_two_views_from_one_place_are_no_model() -> None:
    one, other = (Keyframe.of(n * STEP, view(pose(0.0, 0.1 * n), n), CAMERA) for n in range(2))
    assert len(matched(one, other)) > 100
    assert model_from_pair(one, other, matched(one, other), seed=0) is None
