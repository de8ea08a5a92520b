# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the contour measurement give what plain NumPy gives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.refinement import contour_adjustment, global_search
from pipeprog_detect.refinement.contour_adjustment import FIRST_OFFSET, FLOOR, LEAST_OFFSET, ROBUST, ROUNDS, WORST_EDGE
from pipeprog_detect.silhouette.apparent_contour import ContourSamples, ViewArrays, in_image
from pipeprog_detect.silhouette.light_sampling import LINEAR_LIGHT, light_across, light_at
from pipeprog_detect.silhouette.limb_edges import LimbEdges, least_cost, limb_basis, limb_edges, prior_precision
from pipeprog_detect.silhouette.occlusion import (
    BEFORE,
    MARGIN,
    cylinder_rows,
    depth_of_cylinders,
    hidden_by_cloud,
    hidden_by_cylinders,
)
from pipeprog_detect.types import Cylinder, View

RANDOM = np.random.default_rng(17)
CAMERA = Camera.from_calibration(320, 180, [300.0, 0.0, 159.5, 0.0, 300.0, 89.5, 0.0, 0.0, 1.0], "plumb_bob", [])


def image() -> np.ndarray:
    """A smooth image (180, 320) with edges."""
    y, x = np.mgrid[0:180, 0:320]
    texture = 120.0 + 60.0 * np.sin(0.2 * x + 0.05 * y) + 50.0 * (x + 0.4 * y > 150)
    return np.clip(texture + RANDOM.normal(0.0, 4.0, texture.shape), 0, 255).astype(np.uint8)


def view(nearest: np.ndarray | None = None) -> View:
    """A camera near the origin, turned a little."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    pose[:3, 3] = 0.02, -0.1, 0.05
    return View(0, image(), CAMERA, pose, nearest)


@pytest.mark.parametrize("inner", [True, False])
def test_light_is_that_of_cubic_interpolation(inner: bool) -> None:
    shown = image()
    margin = 15 if inner else -3
    pixel = RANDOM.uniform([margin, margin], [320 - margin, 180 - margin], (60, 2))
    angle = RANDOM.uniform(0.0, 2.0 * np.pi, 60)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.arange(-6.0, 3.0, 0.5, dtype=float)
    shift = np.arange(6) - 2.5
    feet = pixel[:, None] + shift[:, None] * np.stack([-normal[:, 1], normal[:, 0]], axis=1)[:, None]
    at = (feet[:, :, None] + offsets[:, None] * normal[:, None, None]).astype(np.float32)
    light = cv2.LUT(shown, LINEAR_LIGHT)
    mapped = at.reshape(360, -1, 2)
    expected = cv2.remap(light, mapped[..., 0], mapped[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    # OpenCV rounds positions to a 32nd of a pixel; the steepest edge rises by 80 levels over one.
    found = light_across(shown, pixel, normal, np.stack([-normal[:, 1], normal[:, 0]], axis=1), offsets, 6)
    np.testing.assert_allclose(found, expected.reshape(60, 6, -1).mean(axis=1), atol=1.5)
    assert abs(float((found - expected.reshape(60, 6, -1).mean(axis=1)).mean())) < 0.02
    single = light_at(shown, at[:, 0, 0].astype(float))
    np.testing.assert_allclose(single, expected.reshape(60, 6, -1)[:, 0, 0], atol=3.0)


@pytest.mark.parametrize("half_width", [5.0, 30.0])
def test_limb_costs_are_those_of_least_squares(half_width: float) -> None:
    offsets, trials, blur = np.arange(-9.0, 3.5, 0.5, dtype=float), np.arange(-0.8, 0.81, 0.2, dtype=float), 0.6
    width = float(np.exp(np.round(np.log(half_width) / np.log(1.15)) * np.log(1.15)))
    light: FloatArray = 90.0 + np.cumsum(RANDOM.normal(0.0, 5.0, (40, len(offsets))), axis=1).astype(float)
    prior = prior_precision(width)
    expected = [
        [_left(limb_basis(offsets - trial, width, blur), profile, prior) for trial in trials] for profile in light
    ]
    powers: FloatArray = np.vander(offsets / 9.0, len(prior), increasing=True).astype(float)
    shades = np.append(0.0, np.full(len(prior) - 1, prior.max()))
    smooth = [_left(powers, profile, shades) for profile in light]
    cost, plain = least_cost(light.astype(np.float32), offsets, np.full(40, half_width), blur, trials)
    np.testing.assert_allclose(cost, np.min(expected, axis=1), rtol=2e-3, atol=0.05)
    np.testing.assert_allclose(plain, smooth, rtol=2e-3, atol=0.05)


def test_edges_are_the_deepest_minima_with_the_deepest_first() -> None:
    offsets = np.arange(-9.5, 4.0, 0.5, dtype=float)
    light: FloatArray = 90.0 + np.cumsum(RANDOM.normal(0.0, 5.0, (40, len(offsets))), axis=1).astype(float)
    found = limb_edges(light, offsets, np.full(40, 20.0), 0.6, 1.5)
    trials = np.arange(-1.5, 1.55, 0.1)
    width = float(np.exp(np.round(np.log(20.0) / np.log(1.15)) * np.log(1.15)))
    for row, profile in enumerate(light):
        left = [_left(limb_basis(offsets - trial, width, 0.6), profile, prior_precision(width)) for trial in trials]
        cost = np.array(left)
        lowest = [t for t in range(1, len(trials) - 1) if cost[t] < min(cost[t - 1], cost[t + 1])]
        lowest = sorted(lowest, key=lambda t: float(cost[t]))[:3]
        assert np.isfinite(found.offset[row]).sum() == len(lowest)
        np.testing.assert_allclose(found.offset[row, : len(lowest)], trials[lowest], atol=0.06)
        assert (np.diff(found.explained[row, : len(lowest)]) <= 1e-6).all()


def _left(model: FloatArray, profile: FloatArray, precision: FloatArray) -> float:
    """The least sum of the squares of the residuals and of the coefficients times their precision."""
    best = np.linalg.solve(model.T @ model + np.diag(precision), model.T @ profile)
    return float(((profile - model @ best) ** 2).sum() + precision @ best**2)


def test_scores_are_sums_of_linear_interpolation() -> None:
    steps, jacobian = RANDOM.normal(0.0, 0.01, (30, 5)), RANDOM.normal(0.0, 150.0, (200, 5))
    response = RANDOM.random((200, 41)).astype(np.float32)
    offsets = np.arange(-10.0, 10.1, 0.5)
    displaced = steps @ jacobian.T
    expected = [
        sum(np.interp(at, offsets, row, left=0.0, right=0.0) for at, row in zip(each, response, strict=True))
        for each in displaced
    ]
    found = global_search._scores(steps, jacobian, response, -10.0, 0.5)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_cylinders_hide_what_lies_behind_them() -> None:
    seen = view()
    ends = RANDOM.uniform([-1.5, -1.0, -0.5], [1.5, 1.0, 4.0], (25, 2, 3))
    rows = cylinder_rows([Cylinder(start, end, 0.05) for start, end in ends])
    pixel, depth = RANDOM.uniform([0, 0], [320, 180], (400, 2)), RANDOM.uniform(0.3, 5.0, 400)
    rays = np.stack([(pixel[:, 0] - 159.5) / 300.0, (pixel[:, 1] - 89.5) / 300.0, np.ones(400)], axis=1)
    rays = rays @ seen.camera_from_map[:3, :3]
    expected = np.zeros(400, bool)
    for start, axis, length, radius in ((row[:3], row[3:6], row[6], row[7]) for row in rows):
        offset = start - seen.centre
        across = offset - (offset @ axis) * axis
        flat = rays - np.outer(rays @ axis, axis)
        nearest = (flat @ across) / (flat**2).sum(axis=1)
        reach = radius + MARGIN / 300.0 * nearest
        miss = np.linalg.norm(across - nearest[:, None] * flat, axis=1)
        place = nearest * (rays @ axis) - offset @ axis
        expected |= (nearest > 0) & (nearest < depth) & (miss < reach) & (place > -reach) & (place < length + reach)
    np.testing.assert_array_equal(hidden_by_cylinders(seen, pixel, depth, rows), expected)
    assert 0.1 < expected.mean() < 0.9


def test_lines_of_sight_meet_the_first_cylinder() -> None:
    """By the quadratic equation of each cylinder, some of which reach behind the camera."""
    seen = view()
    ends = RANDOM.uniform([-1.5, -1.0, -0.5], [1.5, 1.0, 4.0], (25, 2, 3))
    rows = cylinder_rows([Cylinder(start, end, 0.05) for start, end in ends])
    pixel = RANDOM.uniform([0, 0], [320, 180], (400, 2))
    rays = np.stack([(pixel[:, 0] - 159.5) / 300.0, (pixel[:, 1] - 89.5) / 300.0, np.ones(400)], axis=1)
    rays = rays @ seen.camera_from_map[:3, :3]
    expected = np.full(400, np.inf)
    for start, axis, length, radius in ((row[:3], row[3:6], row[6], row[7]) for row in rows):
        from_axis = seen.centre - start
        from_axis = from_axis - (from_axis @ axis) * axis
        flat = rays - np.outer(rays @ axis, axis)
        square, half = (flat**2).sum(axis=1), flat @ from_axis
        root = half**2 - square * (from_axis @ from_axis - radius**2)
        depth = (-half - np.sqrt(np.maximum(root, 0.0))) / square
        place = depth * (rays @ axis) + (seen.centre - start) @ axis
        met = (root > 0.0) & (depth > 0.0) & (place > 0.0) & (place < length)
        expected[met] = np.minimum(expected, depth)[met]
    np.testing.assert_allclose(depth_of_cylinders(seen, pixel, rows), expected, rtol=1e-9)
    assert 0.1 < np.isfinite(expected).mean() < 0.9


def test_the_cloud_hides_what_lies_behind_it() -> None:
    nearest = RANDOM.uniform(0.5, 3.0, (9, 16)).astype(np.float32)
    seen = view(nearest)
    pixel, depth = RANDOM.uniform([0, 0], [320, 180], (300, 2)), RANDOM.uniform(1.4, 1.6, 300)
    cell = (pixel / 20.0).astype(int)
    slope = np.ptp(1.0 / depth) / np.linalg.norm(np.ptp(pixel, axis=0))
    expected = nearest[cell[:, 1], cell[:, 0]] < depth - BEFORE - slope * 20.0 * depth**2
    np.testing.assert_array_equal(hidden_by_cloud(seen, pixel, depth), expected)


def test_views_that_show_points_are_those_that_in_image_finds() -> None:
    seen = view()
    points = RANDOM.uniform([-2.0, -2.0, -1.0], [2.0, 2.0, 3.0], (40, 1, 3))
    found = [bool(ViewArrays.of([seen, seen]).showing(each)[1]) for each in points]
    assert found == [bool(in_image(seen, each)[0]) for each in points]
    assert 0 < sum(found) < 40


@pytest.mark.parametrize("unknowns", [5, 6])
def test_least_squares_with_offsets_of_views(unknowns: int) -> None:
    """Robust weights, offsets as random effects and their variance, against the same in NumPy."""
    count, views = 300, 8
    number = np.sort(RANDOM.integers(0, views, count))
    side = RANDOM.integers(0, 2, count)
    jacobian = RANDOM.normal(0.0, 200.0, (count, unknowns))
    sign = np.where(side == 0, 1.0, -1.0)
    true = jacobian @ RANDOM.normal(0.0, 1e-3, unknowns) + sign * RANDOM.normal(0.0, 0.2, views)[number]
    offset = true[:, None] + np.stack([RANDOM.normal(0.0, 0.1, count), RANDOM.normal(0.0, 1.5, count)], axis=1)
    offset[RANDOM.random((count, 2)) < 0.1] = np.nan
    sigma = np.where(np.isfinite(offset), RANDOM.uniform(0.05, 0.8, offset.shape), np.inf)
    none = np.zeros(count)
    samples = ContourSamples(number, side, np.zeros((count, 2)), np.zeros((count, 2)), none, none, none, none, jacobian)
    prior, so_far = np.eye(unknowns) * 1e3, RANDOM.normal(0.0, 1e-3, unknowns)
    found = contour_adjustment._solve(samples, LimbEdges(offset, sigma, np.ones_like(offset)), views, prior, so_far)
    step, by_view = _in_numpy(jacobian, sign, number, offset, sigma, views, prior, so_far)
    np.testing.assert_allclose(found.step, step, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(found.view_offset, by_view, atol=1e-8)


def _in_numpy(
    jacobian: FloatArray,
    sign: FloatArray,
    view: np.ndarray,
    place: FloatArray,
    sigmas: FloatArray,
    views: int,
    prior: FloatArray,
    so_far: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Step (K,) and offsets (V,)."""
    unknowns = jacobian.shape[1]
    step, offset, variance = np.zeros(unknowns), np.zeros(views), FIRST_OFFSET**2
    rows = np.arange(len(view))
    for _ in range(ROUNDS):
        predicted = jacobian @ step + sign * offset[view]
        distance = np.where(np.isfinite(place), np.abs(place - predicted[:, None]), np.inf)
        nearest = np.argmin(distance, axis=1)
        used = np.isfinite(distance[rows, nearest]) & (sigmas[rows, nearest] < WORST_EDGE)
        seen = np.where(used, place[rows, nearest], 0.0)
        sigma = np.where(used, sigmas[rows, nearest], 1.0)
        residual = np.where(used, seen - predicted, 0.0)
        weight = used / (sigma**2 + FLOOR**2) / (1.0 + (residual / ROBUST) ** 2)
        weighted = jacobian * weight[:, None]
        own = np.bincount(view, weight, views) + 1.0 / variance
        cross = np.stack([np.bincount(view, sign * column, views) for column in weighted.T], axis=1)
        right = np.bincount(view, sign * weight * seen, views)
        normal = weighted.T @ jacobian - (cross / own[:, None]).T @ cross + prior
        normal += np.diag(np.full(unknowns, 1e-9 * np.trace(normal)))
        step = np.linalg.solve(normal, weighted.T @ seen - cross.T @ (right / own) - prior @ so_far)
        offset = (right - cross @ step) / own
        active = own > 2.0 / variance
        if active.any():
            variance = max(float(np.mean(offset[active] ** 2 + 1.0 / own[active])), LEAST_OFFSET**2)
    return step, offset
