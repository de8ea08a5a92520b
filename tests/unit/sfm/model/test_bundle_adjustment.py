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

from pipeprog_sfm.model import bundle_adjustment
from pipeprog_sfm.model.bundle_adjustment import (
    Bundle,
    adjust,
    eliminate_points,
    pairs_of_views,
    rotation_from_vector,
)


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


def test_residuals_are_those_of_the_pinhole_camera() -> None:
    noisy = bundle(noise=0.3)
    residuals = noisy.residuals()
    for point, (first, last) in enumerate(zip(noisy.start[:-1], noisy.start[1:], strict=True)):
        for k in range(first, last):
            c = noisy.view[k]
            x, y, z = noisy.rotation[c] @ noisy.points[point] + noisy.translation[c]
            expected = noisy.focal[c] * ([x / z, y / z] - noisy.rays[k])
            np.testing.assert_allclose(residuals[k], expected, atol=1e-9)


def test_the_cost_is_the_sum_of_the_logarithms() -> None:
    """Also where the product of all would be beyond what a double holds, and of a point behind all cameras."""
    wrong = bundle(noise=0.3, outliers=0.5)
    wrong.rays[::3] += 1e6
    square = (wrong.residuals() ** 2).sum(axis=1)
    assert np.log10(1.0 + square / 0.25).sum() > 308
    expected = 0.5 * 0.25 * np.log1p(square / 0.25).sum()
    assert bundle_adjustment._cost(*wrong.arrays(), 0.5) == pytest.approx(expected, rel=1e-12)
    behind = replace(wrong, points=wrong.points - [0.0, 0.0, 1e3])
    assert bundle_adjustment._cost(*behind.arrays(), 0.5) == pytest.approx(0.5 * 0.25 * 20.0 * len(wrong.view))


def test_points_are_eliminated_by_the_schur_complement() -> None:
    noisy = bundle(noise=0.3)
    free = np.arange(VIEWS) != 1
    index = np.where(free, np.cumsum(free) - 1, -1)
    count, damping = VIEWS - 1, 0.1
    pairs, row, column = pairs_of_views(noisy.start, noisy.view, index, count)
    u, gc, v, gp, w = bundle_adjustment._linearise(*noisy.arrays(), index, count, 1.0)
    blocks, gradient, inverse = eliminate_points(
        u, gc, v, gp, w, noisy.start, noisy.view, index, pairs, len(row), damping
    )
    whole, expected = np.zeros((count, 6, count, 6)), gc.copy()
    for c in range(count):
        whole[c, :, c] = u[c] + damping * np.diag(np.diag(u[c]))
    for point, (first, last) in enumerate(zip(noisy.start[:-1], noisy.start[1:], strict=True)):
        np.testing.assert_allclose(
            inverse[point], np.linalg.inv(v[point] + damping * np.diag(np.diag(v[point]))), rtol=1e-6
        )
        seeing = [k for k in range(first, last) if free[noisy.view[k]]]
        for k in seeing:
            expected[index[noisy.view[k]]] -= w[k] @ inverse[point] @ gp[point]
            for m in seeing:
                whole[index[noisy.view[k]], :, index[noisy.view[m]]] -= w[k] @ inverse[point] @ w[m].T
    scale = np.abs(whole).max()
    for block, a, b in zip(blocks, row, column, strict=True):
        np.testing.assert_allclose(block, whole[a, :, b], atol=1e-9 * scale)
    np.testing.assert_allclose(gradient, expected, atol=1e-9 * np.abs(gc).max())


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotation_from_vector_is_a_rotation_about_it(vector: list[float]) -> None:
    axis = np.array([vector])
    matrix = rotation_from_vector(axis)[0]
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert matrix @ axis[0] == pytest.approx(axis[0], abs=1e-9)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(axis)), abs=1e-9)
