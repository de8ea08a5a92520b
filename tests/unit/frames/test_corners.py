# SPDX-License-Identifier: Apache-2.0
"""Corners and sharpness against OpenCV's own, which they replace for speed."""

import cv2
import numpy as np
import pytest

from pipeprog_frames.corners import CELLS, corners, sharpness


def textured(seed: int, width: int = 320, height: int = 180) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    return cv2.GaussianBlur(noise, None, 2).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(320, 180), (317, 241), (180, 320)])
def test_each_corner_is_the_maximum_of_its_cell(size: tuple[int, int]) -> None:
    gray = textured(1, *size)
    quality = cv2.cornerMinEigenVal(gray, 3)
    cell = max(gray.shape) // CELLS
    found = corners(gray)
    rows, columns = gray.shape[0] // cell, gray.shape[1] // cell
    assert len(found) == rows * columns
    assert len({(int(x) // cell, int(y) // cell) for x, y in found}) == len(found)
    for x, y in found.astype(int):
        top, left = y // cell * cell, x // cell * cell
        inner = quality[max(top, 2) : top + cell, max(left, 2) : left + cell][:, : gray.shape[1] - 2 - max(left, 2)]
        inner = inner[: gray.shape[0] - 2 - max(top, 2)]  # the image's outermost two pixels have no whole window
        assert quality[y, x] == pytest.approx(inner.max(), rel=1e-4)


def test_a_blank_image_with_noise_has_no_corner() -> None:
    noise = np.random.default_rng(2).normal(128, 2.0, (720, 1280)).astype(np.float32)
    quarter = cv2.resize(noise, (320, 180), interpolation=cv2.INTER_AREA)
    assert len(corners(np.rint(quarter).astype(np.uint8))) == 0


def test_sharpness_is_the_mean_square_of_the_laplacian() -> None:
    gray = textured(3)
    laplacian = cv2.Laplacian(gray, cv2.CV_64F)[1:-1, 1:-1]
    assert sharpness(gray) == pytest.approx(float(np.mean(laplacian**2)), rel=1e-12)


def test_blur_lowers_sharpness() -> None:
    gray = textured(4)
    assert sharpness(cv2.blur(gray, (5, 5))) < 0.5 * sharpness(gray)
