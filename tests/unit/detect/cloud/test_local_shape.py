# SPDX-License-Identifier: Apache-2.0
"""Shape of the cloud around sites."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.cloud import local_shape, octree


def test_a_site_with_more_points_than_are_fitted_sees_all_around_it() -> None:
    """20 points a square millimetre: 6 000 neighbours of each site, of which an even subset is fitted."""
    rng = np.random.default_rng(0)
    points = np.append(rng.uniform(-0.02, 0.02, (32_000, 2)), rng.normal(0.0, 1e-4, (32_000, 1)), axis=1)
    tree = octree.build(points)
    sites = tree.thinned(tree.level_of(0.002))
    sites = sites.subset(np.abs(sites.points[:, :2]).max(axis=1) < 0.01)
    shape = local_shape.surfaces(tree, sites, 0.01, 1e-4)
    assert shape.count.min() > 5_000
    # The mean of 512 points or more, each 5 mm off its site as the standard deviation along each axis has it.
    aside = np.linalg.norm(shape.centres - sites.points, axis=1)
    assert aside.max() < 4.0 * 0.005 / np.sqrt(512)


def test_a_quadric_is_that_of_weighted_least_squares() -> None:
    """Four rounds of Tukey's weights, against the same in NumPy."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-0.02, 0.02, (2, 300))
    z = 3.0 * x**2 - 2.0 * x * y + 0.1 * y + random.normal(0.0, 5e-4, 300) + 0.01 * (random.random(300) < 0.1)
    points = np.stack([x, y, z], axis=1)
    scale, sigma = 0.02, 5e-4
    rows = np.stack([np.ones(300), x, y, x * x / scale, x * y / scale, y * y / scale], axis=1) / scale
    rows[:, 0] *= scale
    weight, q = np.ones(300), np.zeros(6)
    for turn in range(4):
        if turn:
            reach = 4.0 * sigma * (2.0 if turn == 1 else 1.0) / scale
            weight = np.maximum(1.0 - ((z / scale - rows @ q) / reach) ** 2, 0.0) ** 2
        root = np.sqrt(weight)
        left = z / scale - rows @ q
        q = np.linalg.lstsq(rows * root[:, None], z / scale * root, rcond=None)[0]
    found, rms, share, _ = local_shape._solve_quadric(points, np.zeros(3), np.eye(3), scale, sigma, 4)
    np.testing.assert_allclose(found, q, atol=1e-6)
    assert share == np.mean(weight > 0)
    assert rms == pytest.approx(scale * np.sqrt((weight * left**2).sum() / weight.sum()), rel=1e-6)
