# SPDX-License-Identifier: Apache-2.0
"""Frames in which nothing can be measured."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_bringup import frame_quality
from pipeprog_sfm.boards import ellipses

SHAPE = (360, 480)


def room(low: float = 60.0, high: float = 160.0, seed: int = 0) -> NDArray[np.float64]:
    """Rectangles of all greys between two, drawn at four times the size, so that their edges are those of a camera."""
    rng = np.random.default_rng(seed)
    drawn = np.full((4 * SHAPE[0], 4 * SHAPE[1]), low)
    for left, top, width, height in rng.integers((0, 0, 60, 60), (1920, 1440, 400, 400), (150, 4)):
        drawn[top : top + height, left : left + width] = rng.uniform(low, high)
    return drawn.reshape(SHAPE[0], 4, SHAPE[1], 4).mean((1, 3))


def photographed(light: NDArray[np.float64], noise: float = 2.0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(1)
    return np.clip(np.rint(light + rng.normal(0.0, noise, light.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0, 3.0])
def test_a_blur_is_measured_whatever_the_contrast(sigma: float, noise: float) -> None:
    for high in (110.0, 220.0):
        image = photographed(cv2.GaussianBlur(room(high=high), (0, 0), sigma), noise if high > 200 else noise / 3)
        # A pixel's own width (0.3 px) and Sobel's (0.7 px) widen edges; noise makes the steepest ones steeper.
        assert frame_quality.blur(image) == pytest.approx(np.hypot(sigma, 0.8), rel=0.15)


@pytest.mark.parametrize(("length", "fault"), [(1, ""), (5, ""), (11, "blurred"), (41, "blurred")])
def test_a_blur_along_one_direction_counts(length: int, fault: str) -> None:
    shaken = cv2.blur(room(), (length, 1))
    assert frame_quality.fault_of(photographed(shaken)) == fault
    assert frame_quality.fault_of(photographed(shaken).T.copy()) == fault


@pytest.mark.parametrize(
    ("light", "fault"), [(1.0, ""), (0.4, ""), (0.1, "flat"), (1.7, ""), (5.0, "overexposed"), (100.0, "overexposed")]
)
def test_light_is_told(light: float, fault: str) -> None:
    assert frame_quality.fault_of(photographed(light * room())) == fault


def test_what_shows_no_edge_is_not_called_blurred() -> None:
    assert frame_quality.blur(np.full(SHAPE, 90, np.uint8)) == 0.0
    assert frame_quality.blur(photographed(np.full(SHAPE, 90.0))) < 1.0
    assert frame_quality.blur(np.full((20, 20), 90, np.uint8)) == 0.0


def test_the_largest_blur_is_that_of_an_edge_that_a_circle_may_have() -> None:
    x = np.arange(-ellipses.MAX_REACH, ellipses.MAX_REACH, 0.01)
    fall = np.exp(-0.5 * (x / ellipses.MAX_BLUR) ** 2)
    share = fall[np.abs(x) <= ellipses.EDGE_HALF_WIDTH].sum() / fall.sum()
    assert share == pytest.approx(ellipses.MIN_EDGE_SHARE, abs=0.01)
