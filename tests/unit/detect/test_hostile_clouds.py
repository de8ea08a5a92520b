# SPDX-License-Identifier: Apache-2.0
"""Clouds and views that no survey has: the detector ends with pipes or with an InputError, and in time."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_COORDINATE
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.types import Cloud, View

BOQ = BillOfQuantities.of_radii({"DN100": 0.0575, "DN50": 0.0302})
RNG = np.random.default_rng(0)
NOISE = RNG.integers(0, 256, (360, 640)).astype(np.uint8)
CAMERA = Camera(640, 360, 450.0, 450.0, 319.5, 179.5)


def barrel(count: int = 3000) -> FloatArray:
    angle, radius = RNG.uniform(-1.3, 1.3, count), 0.0575 + RNG.normal(0.0, 5e-4, count)
    return np.c_[RNG.uniform(0.0, 1.0, count), -np.cos(angle) * radius, np.sin(angle) * radius]


CLOUDS = {
    "one point": np.zeros((1, 3)),
    "two points": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
    "two ends of the world": MAX_COORDINATE * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
    "one place": np.tile([1.0, 2.0, 3.0], (1000, 1)),
    "two places": np.repeat([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0]], 500, axis=0),
    "a line": np.c_[np.linspace(0.0, 1e8, 2000), np.zeros((2000, 2))],
    "a huge plane": np.c_[RNG.uniform(-1e4, 1e4, (5000, 2)), RNG.normal(0.0, 1e-3, 5000)],
    "an exact plane": np.c_[RNG.uniform(-2.0, 2.0, (5000, 2)), np.zeros(5000)],
    "a grid": 0.01 * np.stack(np.meshgrid(*3 * [np.arange(12.0)]), -1).reshape(-1, 3),
    "nothing but tiny numbers": 1e-320 * RNG.normal(size=(500, 3)),
    "a pipe at the end of the world": barrel() + MAX_COORDINATE,
    "a pipe and single points far away": np.r_[barrel(), RNG.uniform(-1e8, 1e8, (50, 3))],
    "a pipe of repeated points": np.repeat(barrel(150), 30, axis=0),
}


def looking(at: FloatArray, image: np.ndarray, camera: Camera, apart: float) -> list[View]:
    """Four views along a line, 1.5 m before a point."""
    views = []
    for number in range(4):
        camera_from_map = np.eye(4)
        camera_from_map[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
        camera_from_map[:3, 3] = -camera_from_map[:3, :3] @ (at + np.array([apart * (number - 1.5), -1.5, 0.0]))
        views.append(View(number, image, camera, camera_from_map))
    return views


@pytest.mark.parametrize("points", CLOUDS.values(), ids=CLOUDS)
def test_a_degenerate_cloud_has_few_pipes_or_none(points: FloatArray) -> None:
    directions = RNG.normal(size=points.shape)
    normals = directions / np.linalg.norm(directions, axis=1)[:, None]
    middle = np.median(points, axis=0)
    for given_normals in (None, normals):
        assert len(detect(Cloud(points, given_normals), BOQ, DetectConfig())) <= 1
    assert len(detect(Cloud(points), BOQ, DetectConfig(concave=True))) <= 1
    assert len(detect(Cloud(points, normals), BOQ, DetectConfig(), looking(middle, NOISE, CAMERA, 0.3))) <= 1


@pytest.mark.parametrize(
    ("image", "camera", "apart"),
    [
        (NOISE, CAMERA, 0.0),
        (np.full((360, 640), 128, np.uint8), CAMERA, 0.3),
        (NOISE[:16, :16].copy(), Camera(16, 16, 10.0, 10.0, 7.5, 7.5), 0.3),
        (NOISE, CAMERA, 1e8),
    ],
    ids=["one place", "one colour", "16 pixels", "ends of the world"],
)
def test_views_that_show_nothing_end_no_detection(image: np.ndarray, camera: Camera, apart: float) -> None:
    points = barrel()
    detect(Cloud(points), BOQ, DetectConfig(), looking(np.median(points, axis=0), image, camera, apart))


COORDINATES = st.sampled_from([0.0, 1e-9, 0.01, 0.05, 0.1, 1.0, -1.0, 1e4, MAX_COORDINATE, -MAX_COORDINATE, np.nan])
POINTS = arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=COORDINATES)


@given(few=POINTS, times=st.integers(1, 20), on_a_pipe=st.integers(0, 400), concave=st.booleans())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_a_detection_ends_with_pipes_or_an_input_error(
    few: FloatArray, times: int, on_a_pipe: int, concave: bool
) -> None:
    points = np.r_[np.repeat(few, times, axis=0), barrel(400)[:on_a_pipe]]
    with contextlib.suppress(InputError):
        detect(Cloud(points), BOQ, DetectConfig(concave=concave))
