# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a synthetic scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import VIEWS, bundle

from pipeprog_sfm.model.bundle_adjustment import Bundle, adjust, rotation_from_vector


def disturbed(truth: Bundle, free: NDArray[np.bool_]) -> Bundle:
    rng = np.random.default_rng(1)
    turn = np.where(free[:, None], rng.normal(0, 0.005, (VIEWS, 3)), 0)
    shift = np.where(free[:, None], rng.normal(0, 0.01, (VIEWS, 3)), 0)
    start = replace(
        truth,
        rotation=rotation_from_vector(turn) @ truth.rotation,
        translation=truth.translation + shift,
        points=truth.points + rng.normal(0, 0.02, truth.points.shape),
    )
    return adjust(start, free, loss_scale=1.0, max_iterations=40, tolerance=1e-10)


def test_exact_observations_give_back_the_bundle() -> None:
    truth = bundle(noise=0.0)
    free = np.ones(VIEWS, bool)
    free[[0, 5]] = False  # two fixed views fix the scale too
    result = disturbed(truth, free)
    assert np.abs(result.residuals()).max() < 1e-4
    assert result.points == pytest.approx(truth.points, abs=1e-6)
    assert result.translation == pytest.approx(truth.translation, abs=1e-6)
    assert (result.rotation[~free] == truth.rotation[~free]).all()


def test_gross_errors_hardly_move_the_result() -> None:
    truth = bundle(noise=0.3, outliers=0.1)
    free = np.ones(VIEWS, bool)
    free[[0, 5]] = False
    result = disturbed(truth, free)
    # 150 points of 0.3 px each at 2 m hold a camera to some 0.1 mm; the outliers of 50 px would move it by 10 mm.
    assert np.abs(result.translation - truth.translation).max() < 0.002


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotation_from_vector_is_a_rotation_about_it(vector: list[float]) -> None:
    axis = np.array([vector])
    matrix = rotation_from_vector(axis)[0]
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert matrix @ axis[0] == pytest.approx(axis[0], abs=1e-9)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(axis)), abs=1e-9)
