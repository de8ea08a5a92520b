# SPDX-License-Identifier: Apache-2.0
"""Adjustment of a sparse model: which points tell its poses."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import FOCAL, POINTS, VIEWS, sparse_model

from pipeprog_sfm.model.model_adjustment import ENOUGH, adjust_model, adjust_views
from pipeprog_sfm.model.sparse_model import NONE, SparseModel

SHIFT = 1.5 / FOCAL  # of a wrong match, less than what is taken for an error
FEW = 20  # points of many views, beside which others may tell a pose


def with_pairs(count: int) -> SparseModel:
    """The model with `count` points that only the last two views see, in the last one where they are not."""
    built = sparse_model()
    for view in range(VIEWS - 2):
        built.point_of[built.offsets[view] : built.offsets[view] + count] = NONE
    last = built.offsets[VIEWS - 1]
    built.rays[last : last + count, 1] += SHIFT
    return built


@pytest.mark.parametrize("locally", [False, True])
def test_points_of_two_views_tell_no_poses_where_others_do(locally: bool) -> None:
    built = with_pairs(POINTS - ENOUGH)
    rotation, translation = built.rotation.copy(), built.translation.copy()
    if locally:
        adjust_views(built, np.array([VIEWS - 2, VIEWS - 1]))
    else:
        adjust_model(built)
    assert built.rotation == pytest.approx(rotation, abs=1e-6)
    assert built.translation == pytest.approx(translation, abs=1e-6)


def test_points_of_two_views_go_with_these() -> None:
    built = with_pairs(POINTS - ENOUGH)
    adjust_model(built)
    wrong = built.point_of[built.offsets[VIEWS - 1] : built.offsets[VIEWS - 1] + POINTS - ENOUGH]
    assert (wrong >= 0).all()
    # Two views share a shift that no depth explains.
    errors = built.errors(np.arange(built.offsets[VIEWS - 1], built.offsets[VIEWS - 1] + POINTS - ENOUGH))
    assert errors.max() < 0.8 * SHIFT * FOCAL


def test_where_others_are_few_points_of_two_views_tell_the_pose() -> None:
    built = with_pairs(POINTS - FEW)
    before = built.rotation[-1].copy()
    adjust_model(built)
    assert np.abs(built.rotation[-1] - before).max() > 1e-4
