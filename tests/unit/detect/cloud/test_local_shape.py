# SPDX-License-Identifier: Apache-2.0
"""Shape of the cloud around sites."""

from __future__ import annotations

import numpy as np

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
