# SPDX-License-Identifier: Apache-2.0
"""Ends of a barrel: where the points end, before an elbow, across clamps."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.axial_extent import straight_interval, surface_intervals
from pipeprog_detect.types import Cylinder

RADIUS = 0.05
BARREL = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), RADIUS)


def half_pipe(low: float, high: float, per_metre: int = 8000, noise: float = 1e-3, seed: int = 0) -> FloatArray:
    """Points of the half seen from +x of a pipe of RADIUS along z."""
    rng = np.random.default_rng(seed)
    count = int(per_metre * (high - low))
    angle, height = rng.uniform(-1.3, 1.3, count), rng.uniform(low, high, count)
    points = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), height], axis=1)
    return points + rng.normal(0.0, noise, points.shape)


@pytest.mark.parametrize(("low", "high", "per_metre"), [(0.0, 1.0, 8000), (0.137, 0.842, 8000), (0.1, 0.9, 1000)])
def test_ends_are_found_within_a_bin(low: float, high: float, per_metre: int) -> None:
    intervals = surface_intervals(half_pipe(low, high, per_metre), BARREL)
    bin_length = max(0.005, 12.0 / per_metre)
    assert intervals[0].low == pytest.approx(low, abs=0.7 * bin_length)
    assert intervals[-1].high == pytest.approx(high, abs=0.7 * bin_length)


def test_stray_points_make_no_pipe() -> None:
    stray = half_pipe(1.0, 2.0, per_metre=60, seed=5)
    intervals = surface_intervals(np.concatenate([half_pipe(0.0, 1.0), stray]), BARREL)
    assert max(interval.high for interval in intervals if interval.length > 0.05) == pytest.approx(1.0, abs=0.01)


def test_a_clamp_leaves_two_runs() -> None:
    intervals = surface_intervals(np.concatenate([half_pipe(0.0, 0.5), half_pipe(0.56, 1.0)]), BARREL)
    seen = [(round(each.low, 2), round(each.high, 2)) for each in intervals if each.length > 0.05]
    assert seen == [(0.0, 0.5), (0.56, 1.0)]


def test_the_barrel_ends_where_an_elbow_begins() -> None:
    points = half_pipe(0.0, 1.2)
    beyond = np.clip(points[:, 2] - 0.8, 0.0, None)
    points[:, 1] += beyond**2 / (2.0 * 3.0 * RADIUS)
    off = np.abs(np.hypot(points[:, 0], points[:, 1]) - RADIUS)
    straight = straight_interval(points[off < 0.2 * RADIUS], BARREL, 1.2e-3)
    assert straight is not None
    assert straight.low == pytest.approx(0.0, abs=0.02)
    assert straight.high == pytest.approx(0.8, abs=0.25 * RADIUS)


def test_a_wavy_pipe_is_straight() -> None:
    points = half_pipe(0.0, 1.0)
    points[:, 1] += 2e-3 * np.sin(12.0 * points[:, 2])
    straight = straight_interval(points, BARREL, 1.2e-3)
    assert straight is not None
    assert straight.length > 0.97
