# SPDX-License-Identifier: Apache-2.0
"""The cylinder fit against synthetic truth: wrong starts, noise along the ray, its sigma."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.cylinder_fit import basis, covered_arc, fit_cylinder, quick_fit
from pipeprog_detect.types import Cylinder

LENGTH = 0.5


def pipe(
    rng: np.random.Generator, radius: float, noise: float, arc_deg: float = 150.0, count: int = 3000
) -> FloatArray:
    """Points of a pipe along z, seen from +x."""
    angle = rng.uniform(-0.5, 0.5, count) * np.radians(arc_deg)
    height = rng.uniform(-0.5, 0.5, count) * LENGTH
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return points + rng.normal(0.0, noise, points.shape)


def start(radius: float, tilt_deg: float, aside: float, direction: float) -> Cylinder:
    """A start for the fit whose axis is tilted and shifted [m] towards `direction` [rad]."""
    across = np.array([np.cos(direction), np.sin(direction), 0.0])
    axis = np.cos(np.radians(tilt_deg)) * np.array([0.0, 0.0, 1.0]) + np.sin(np.radians(tilt_deg)) * across
    return Cylinder(aside * across - 0.5 * LENGTH * axis, aside * across + 0.5 * LENGTH * axis, radius)


def test_basin_of_ten_degrees_and_a_fifth_of_the_radius() -> None:
    radius, converged = 0.0365, 0
    rng = np.random.default_rng(3)
    for trial in range(40):
        points = pipe(rng, radius, 2e-3, count=1500)
        begin = start(radius * (1.2 if trial % 2 else 0.8), 10.0, 5e-3, rng.uniform(0.0, 2.0 * np.pi))
        fit = fit_cylinder(points, begin, 2e-3)
        converged += fit is not None and abs(fit.cylinder.radius / radius - 1.0) < 0.03
    assert converged >= 39


def test_noise_along_the_ray_leaves_the_radius_unbiased() -> None:
    radius, noise = 0.0575, 3e-3
    errors, sigmas = [], []
    for seed in range(10):
        points = pipe(np.random.default_rng(seed), radius, 0.35 * noise, arc_deg=140.0)
        points[:, 0] += np.random.default_rng(100 + seed).normal(0.0, 0.94 * noise, len(points))
        fit = fit_cylinder(points, start(radius, 0.0, 1e-3, 0.0), noise, reach=1.0)
        assert fit is not None
        errors.append(fit.cylinder.radius - radius)
        sigmas.append(fit.radius_sigma)
    # Orthogonal distances alone give -1.0 mm here.
    assert abs(np.mean(errors)) < 0.25e-3
    assert 0.3 < np.std(errors) / np.mean(sigmas) < 3.0


@settings(max_examples=15, deadline=None)
@given(st.floats(0.02, 0.2), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 1)), st.floats(-50.0, 50.0))
def test_exact_points_give_the_exact_cylinder_anywhere(
    radius: float, direction: tuple[float, float, float], place: float
) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    u, v = basis(axis)
    angle, height = np.meshgrid(np.linspace(-1.2, 1.2, 61), np.linspace(0.0, 1.0, 12))
    angle, height = angle.ravel()[:, None], height.ravel()[:, None]
    origin = np.array([place, -place, 0.5 * place])
    points = origin + radius * (np.cos(angle) * u + np.sin(angle) * v) + height * axis
    begin = Cylinder(origin + 0.02 * radius * u, origin + axis, 1.03 * radius)
    fit = fit_cylinder(points, begin, 1e-3, reach=4.0)
    assert fit is not None
    assert fit.cylinder.radius == pytest.approx(radius, abs=1e-5)
    assert abs(fit.cylinder.axis @ axis) == pytest.approx(1.0, abs=1e-8)
    assert covered_arc(points, fit.cylinder) == pytest.approx(2.4, abs=0.2)


def test_fixed_radius_stays() -> None:
    points = pipe(np.random.default_rng(0), 0.0365, 1e-3)
    fit = fit_cylinder(points, start(0.0365, 1.0, 1e-3, 0.0), 1e-3, fixed_radius=0.0365)
    assert fit is not None
    assert fit.cylinder.radius == 0.0365
    assert fit.radius_sigma == 0.0


def test_arcs_on_two_sides_do_not_add_up() -> None:
    barrel = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.05)
    angle = np.concatenate([np.linspace(-0.4, 0.4, 200), np.linspace(1.6, 2.0, 100)])
    points = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.linspace(0.0, 1.0, 300)], axis=1)
    assert np.degrees(covered_arc(points, barrel)) == pytest.approx(46.0, abs=11.0)


def test_too_few_points_are_no_cylinder() -> None:
    barrel = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.05)
    assert fit_cylinder(np.zeros((5, 3)), barrel, 1e-3) is None
    assert fit_cylinder(np.full((50, 3), 9.0), barrel, 1e-3) is None


def test_a_quick_fit_is_near_the_fit_that_it_starts() -> None:
    points = pipe(np.random.default_rng(11), 0.04, 1e-3)
    quick, fit = (
        quick_fit(points, start(0.04, 2.0, 2e-3, 0.003), 1e-3, 4.0),
        fit_cylinder(points, start(0.04, 0.0, 1e-3, 0.0), 1e-3),
    )
    assert quick is not None
    assert fit is not None
    cylinder, rmse = quick
    # Noise along the ray draws the plain geometric radius in by several of its variances over the radius.
    assert cylinder.radius == pytest.approx(fit.cylinder.radius, abs=2e-4)
    assert rmse == pytest.approx(fit.rmse, rel=0.05)
    assert quick_fit(np.full((50, 3), 9.0), start(0.04, 0.0, 1e-3, 0.0), 1e-3, 4.0) is None
