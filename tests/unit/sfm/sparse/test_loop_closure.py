# SPDX-License-Identifier: Apache-2.0
"""Loop closure on a chain of views: which views move, and how far."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import POINTS, VIEWS, sparse_model

from pipeprog_sfm.model.bundle_adjustment import rotation_from_vector
from pipeprog_sfm.model.sparse_model import NONE
from pipeprog_sfm.sparse.loop_closure import correction_weights, distribute_correction, is_drift, loop_candidates

SCALE = 1.02
CORRECTION = np.eye(4)
CORRECTION[:3, :3] = rotation_from_vector(np.array([[0.0, 0.02, 0.01]]))[0]
CORRECTION[:3, 3] = [0.0, 0.02, 0.0]


def test_views_that_share_as_many_points_take_half_of_a_correction() -> None:
    # Each of six views sees all points.
    assert correction_weights(sparse_model(), np.array([0]), VIEWS - 1) == pytest.approx(
        [0.0, *[0.5] * (VIEWS - 2), 1.0], abs=1e-6
    )


def test_a_weight_of_one_for_all_is_the_similarity_itself() -> None:
    model = sparse_model()
    points, centres = model.points.copy(), model.centres()
    distribute_correction(model, np.ones(VIEWS), SCALE, CORRECTION)
    assert model.points == pytest.approx(SCALE * points @ CORRECTION[:3, :3].T + CORRECTION[:3, 3], abs=1e-9)
    assert model.centres() == pytest.approx(SCALE * centres @ CORRECTION[:3, :3].T + CORRECTION[:3, 3], abs=1e-9)
    assert model.errors(np.arange(VIEWS * POINTS)).max() < 1e-6


def test_views_move_by_their_weights_and_points_with_who_saw_them_first() -> None:
    model = sparse_model()
    points, centres = model.points.copy(), model.centres()
    distribute_correction(model, np.array([0.0, 0, 0, 0.5, 1, 1]), 1.0, CORRECTION)
    assert (model.points == points).all(), "the first view saw them all, and stays"
    assert model.centres()[:3] == pytest.approx(centres[:3], abs=1e-12)
    assert model.centres()[4] == pytest.approx(CORRECTION[:3, :3] @ centres[4] + CORRECTION[:3, 3], abs=1e-9)
    half, whole = (np.linalg.norm(model.centres()[view] - centres[view]) for view in (3, 4))
    assert 0.3 * whole < half < 0.7 * whole


@pytest.mark.parametrize(("metres", "drifted"), [(0.01, True), (0.2, False)])
def test_drift_is_small_against_the_path(metres: float, drifted: bool) -> None:
    shift = np.eye(4)
    shift[1, 3] = metres  # the views stand along 1 m
    assert is_drift(sparse_model(), VIEWS - 1, 0, 1.0, shift) == drifted


def test_distant_views_are_candidates_while_no_point_is_shared_with_them() -> None:
    model = sparse_model()
    assert not len(loop_candidates(model, VIEWS - 1)), "all six views are within the window"
    assert not len(loop_candidates(model, VIEWS - 1, window=1)), "they share all points"
    model.point_of[model.features(VIEWS - 1)] = NONE
    assert loop_candidates(model, VIEWS - 1, window=1).tolist() == [0, 1, 2]
