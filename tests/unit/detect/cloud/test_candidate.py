# SPDX-License-Identifier: Apache-2.0
"""A hypothesis measured on a cloud that holds more than its pipe."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.axis_voting import Hypothesis, Sector
from pipeprog_detect.cloud.candidate import fit_candidate
from pipeprog_detect.types import Cylinder

LENGTH = 0.5
ARC = np.radians(150.0)  # of the circumference that is seen, from +x


def pipe_before_wall(rng: np.random.Generator, radius: float, noise: float) -> FloatArray:
    """Points of a pipe along z, and a fifth of a wall 1.2 radii behind its axis."""
    count, behind = 3000, 750
    angle = rng.uniform(-0.5, 0.5, count) * ARC
    barrel = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.5, 0.5, count) * LENGTH], axis=1)
    width = rng.uniform(-3.0 * radius, 3.0 * radius, behind)
    wall = np.stack([np.full(behind, -1.2 * radius), width, rng.uniform(-0.5, 0.5, behind) * LENGTH], axis=1)
    points = np.concatenate([barrel, wall])
    return points + rng.normal(0.0, noise, points.shape)


@pytest.mark.parametrize(("radius", "noise"), [(0.0365, 2e-3), (0.0365, 4e-3), (0.1223, 2e-3)])
def test_wall_behind_the_pipe_does_not_draw_the_radius(radius: float, noise: float) -> None:
    tilt = np.radians(5.0)
    half = 0.5 * LENGTH * np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    start = Cylinder(-half, half, 1.1 * radius)
    sector = Sector(np.array([1.0, 0.0, 0.0]), 0.5 * ARC)
    errors = []
    for seed in range(8):
        points = pipe_before_wall(np.random.default_rng(seed), radius, noise)
        found = fit_candidate(octree.build(points), np.ones(len(points), bool), Hypothesis(start, 1, sector), noise)
        assert found is not None
        errors.append(found.cylinder.radius - radius)
    # Fitted to the whole circumference the thin ones err by 3 and 4 mm.
    assert abs(np.mean(errors)) < 0.2e-3
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 * noise + 0.1e-3


def test_where_both_ends_of_an_arc_lie_too_far_out_the_radius_can_be_held() -> None:
    """Stereo spreads the ends of 75 deg of a DN100 outwards by 6 mm: its points agree with a plane as with a pipe."""
    radius, half, noise = 0.0575, np.radians(37.5), 1e-3
    start = Cylinder(np.array([0.0, 0.0, -0.5]), np.array([0.0, 0.0, 0.5]), radius)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(-half, half, 3000)
        seen = radius + 6e-3 * (angle / half) ** 4
        points = np.stack([seen * np.cos(angle), seen * np.sin(angle), rng.uniform(-0.5, 0.5, 3000)], axis=1)
        tree = octree.build(points + rng.normal(0.0, noise, points.shape))
        free = np.ones(len(points), bool)
        assert fit_candidate(tree, free, Hypothesis(start, 9), noise) is None
        held = fit_candidate(tree, free, Hypothesis(start, 9), noise, hold_radius=True)
        assert held is not None
        assert held.radius_held
        assert held.cylinder.radius == radius
        assert np.linalg.norm(held.cylinder.middle[:2]) < noise
        assert held.cylinder.length == pytest.approx(1.0, abs=0.02)
        # The radius is not told: the ends of the arc may lie out by 1.8 mm all along, a fifth of which is the sagitta.
        assert held.radius_sigma == pytest.approx(8.7e-3, rel=0.1)


@pytest.mark.parametrize(("gap", "bridged"), [(5.0, True), (9.5, True), (11.0, False)])
def test_a_pipe_is_followed_behind_what_hides_ten_radii_of_it(gap: float, bridged: bool) -> None:
    """`gap`: between the two stretches of it that are seen, in radii. The hypothesis is of the shorter one."""
    radius, noise = 0.0841, 3e-3
    near, far = 2.5 * radius, 4.0 * radius
    rng = np.random.default_rng(0)
    angle = rng.uniform(-0.5, 0.5, 3000) * ARC
    along = np.where(np.arange(3000) < 1000, rng.uniform(-near, 0.0, 3000), gap * radius + rng.uniform(0.0, far, 3000))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), along], axis=1)
    tree = octree.build(points + rng.normal(0.0, noise, points.shape))
    start = Cylinder(np.array([0.0, 0.0, -near]), np.array([0.0, 0.0, 0.0]), 0.95 * radius)
    found = fit_candidate(tree, np.ones(3000, bool), Hypothesis(start, 9), noise)
    assert found is not None
    assert found.cylinder.length == pytest.approx(near + (gap * radius + far if bridged else 0.0), abs=0.02)
    assert found.cylinder.radius == pytest.approx(radius, abs=0.5 * noise)
