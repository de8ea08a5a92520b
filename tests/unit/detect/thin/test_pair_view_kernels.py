# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the segment pairs' depths give what plain NumPy gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_detect.silhouette.apparent_contour import project
from pipeprog_detect.thin import pair_views
from pipeprog_detect.thin.percentiles import by_bin, percentile
from pipeprog_detect.types import View

RANDOM = np.random.default_rng(3)


def test_percentiles_of_bins() -> None:
    cell = RANDOM.integers(0, 12, 90)
    depth = RANDOM.uniform(1.0, 2.0, 90).astype(np.float32)
    cell[cell == 5] = 6
    cell[:2] = 5  # fewer than three tell nothing
    expected = [np.percentile(depth[cell == k], 30.0) if (cell == k).sum() >= 3 else np.nan for k in range(13)]
    np.testing.assert_allclose(by_bin(cell, depth, 13, 30.0), expected, rtol=1e-6)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(0.0, 100.0))
def test_a_percentile_is_that_of_numpy(values: list[float], percent: float) -> None:
    assert percentile(np.array(values), percent) == pytest.approx(np.percentile(values, percent), rel=1e-9, abs=1e-9)


def test_points_in_a_view() -> None:
    camera = Camera.from_calibration(320, 180, [300.0, 0.0, 159.5, 0.0, 300.0, 89.5, 0.0, 0.0, 1.0], "plumb_bob", [])
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 0.3
    view = View(0, np.zeros((180, 320), np.uint8), camera, pose)
    points = RANDOM.uniform(-2.0, 2.0, (500, 3))
    pixel, depth = project(view, points)
    inside = (depth > 0.05) & (pixel > 0).all(axis=1) & (pixel < [319, 179]).all(axis=1)
    found, far = pair_views._points_in(view, points.astype(np.float32))
    np.testing.assert_allclose(found, pixel[inside], atol=1e-2)
    np.testing.assert_allclose(far, depth[inside], rtol=1e-5)
    assert 0 < len(far) < 250


def test_pixels_beside_a_segment() -> None:
    pixel = RANDOM.uniform(0.0, 100.0, (400, 2)).astype(np.float32)
    depth = RANDOM.uniform(1.0, 2.0, 400).astype(np.float32)
    ends = np.array([[20.0, 30.0], [70.0, 60.0]])
    length = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / length
    place = (pixel - ends[0]) @ along
    aside = (pixel - ends[0]) @ np.array([-along[1], along[0]])
    near = (place > 0) & (place < length) & (np.abs(aside) < 12.0)
    found = pair_views._along(pixel, depth, ends, length, 12.0)
    for got, expected in zip(found, (place[near], aside[near], depth[near]), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5)
