# SPDX-License-Identifier: Apache-2.0
"""The linear octree against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_detect.cloud import octree


def points(seed: int, count: int = 2000) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 2.0, (count, 3))


def test_cells_hold_exactly_the_points_in_them() -> None:
    given_points = points(0)
    tree = octree.build(given_points)
    np.testing.assert_array_equal(tree.points, given_points[tree.order])
    cells = tree.cells(tree.level_of(0.25))
    centre = np.repeat(tree.centres(cells), cells.counts, axis=0)
    assert np.abs(tree.points - centre).max() <= 0.5 * cells.size + 1e-9
    assert cells.starts[-1] == len(given_points)
    assert (np.diff(cells.keys) > 0).all()


def test_thinning_gives_the_mean_of_each_cell() -> None:
    tree = octree.build(points(1))
    level = tree.level_of(0.5)
    cells, thin = tree.cells(level), tree.thinned(level)
    for row in range(0, len(thin.points), 17):
        cell = thin.order[row]
        mean = tree.points[cells.starts[cell] : cells.starts[cell + 1]].mean(axis=0)
        np.testing.assert_allclose(thin.points[row], mean, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 100), st.floats(0.01, 0.8))
def test_points_near_a_segment_are_all_found(seed: int, distance: float) -> None:
    tree = octree.build(points(seed, 500))
    start, end = np.random.default_rng(seed + 1).uniform(-1.0, 2.0, (2, 3))
    axis = (end - start) / np.linalg.norm(end - start)
    along = (tree.points - start) @ axis
    off = np.linalg.norm(tree.points - start - along[:, None] * axis, axis=1)
    expected = np.flatnonzero((off < distance) & (along >= 0) & (along <= np.linalg.norm(end - start)))
    np.testing.assert_array_equal(tree.near_segment(start, end, distance), expected)


def test_the_order_of_the_points_does_not_matter() -> None:
    given_points = np.concatenate([points(3), points(3)[:50] + 1e-7])
    shuffled = given_points[np.random.default_rng(4).permutation(len(given_points))]
    np.testing.assert_array_equal(octree.build(given_points).points, octree.build(shuffled).points)


@pytest.mark.parametrize("extent", [1e-3, 1.0, 500.0])
def test_any_extent_fits_the_keys(extent: float) -> None:
    tree = octree.build(extent * points(5))
    assert len(tree.points) == 2000
    assert (np.diff(tree.keys) >= 0).all()


def test_no_points_make_an_empty_tree() -> None:
    tree = octree.build(np.zeros((0, 3)))
    assert len(tree.near_segment(np.zeros(3), np.ones(3), 1.0)) == 0
