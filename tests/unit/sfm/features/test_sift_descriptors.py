# SPDX-License-Identifier: Apache-2.0
"""Descriptors against OpenCV's, and of images that are turned, enlarged, brighter or cut off."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.sift import root_sift
from pipeprog_sfm.features.sift_descriptors import LAYERS, SIGMA, describe

SIFT = cv2.SIFT.create(400, LAYERS, sigma=SIGMA, enable_precise_upscale=True)
SAME = 0.99  # cosine: 8 degrees, of 45 from which on two descriptors are of different places
LESS_SAME = 0.97  # 14 degrees: of half a patch, which has half as many samples


def texture(size: int, seed: int, grain: float = 2.0) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0, 1, (size, size)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def cosines(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(a.astype(float), axis=1) * np.linalg.norm(b.astype(float), axis=1)
    return np.asarray((a.astype(float) * b).sum(axis=1) / lengths)


@pytest.mark.parametrize("grain", [1.0, 3.0, 8.0])  # px: keypoints of the first to the fourth octave
def test_they_are_those_of_opencv(grain: float) -> None:
    image = texture(480, 1, grain)
    found, expected = SIFT.detectAndCompute(image, None)
    alike = cosines(root_sift(describe(image, found)), root_sift(expected))
    assert len(alike) > 200
    assert (alike > SAME).mean() > 0.99
    assert np.median(alike) > 0.996


@settings(max_examples=10, deadline=None)
@given(st.floats(-180, 180), st.floats(0.7, 1.4), st.floats(0.5, 1.2), st.integers(0, 2**16))
def test_a_turned_enlarged_and_darker_image_has_the_same(turn: float, size: float, gain: float, seed: int) -> None:
    """As many keypoints as with OpenCV's descriptors are matched with the one of their place."""
    image = texture(360, seed)
    warp = cv2.getRotationMatrix2D((180, 180), turn, size)
    other = np.clip(gain * cv2.warpAffine(image, warp, (360, 360)), 0, 255).astype(np.uint8)
    found = [SIFT.detect(each, None) for each in (image, other)]
    right = []
    for ways in (describe, lambda each, points: SIFT.compute(each, points)[1]):
        first, second = (root_sift(ways(each, points)) for each, points in zip((image, other), found, strict=True))
        pairs = match(first, second)
        places = np.array([found[0][index].pt for index in pairs[:, 0]])
        there = np.array([found[1][index].pt for index in pairs[:, 1]])
        gaps = np.linalg.norm(places @ warp[:, :2].T + warp[:, 2] - there, axis=1)
        right.append(int((gaps < 2.0).sum()))
    assert right[0] > 0.95 * right[1] > 50


def test_patches_beyond_the_border_are_described_by_what_is_inside() -> None:
    size = 200
    image = texture(size, 2, 4.0)
    found, expected = SIFT.detectAndCompute(image, None)
    places, reach = np.array([point.pt for point in found]), np.array([6.0 * point.size for point in found])
    outside = np.minimum(places, size - 1 - places).min(axis=1) < reach
    assert outside.sum() > 100
    alike = cosines(root_sift(describe(image, found)), root_sift(expected))
    assert alike[outside].min() > LESS_SAME


def test_no_keypoints_have_no_descriptors() -> None:
    assert describe(texture(64, 0), []).shape == (0, 128)
