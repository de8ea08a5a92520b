# SPDX-License-Identifier: Apache-2.0
"""Corners to track, the best of each cell of an image (Shi and Tomasi, CVPR 1994), and the sharpness of an image.

cv2.cornerMinEigenVal with an argmax per cell finds the same corners (112 of 112 on a frame of the demo) in 0.30 ms;
these loops need 0.09 ms, which counts in the 1.1 ms that the selector has spent on a frame. They make three rows of
gradient products at a time in place of whole images, and read a row's neighbours through shifted views, which the
compiler turns into SIMD instructions.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_frames.incoming.decoding import GrayImage

PointArray = NDArray[np.float32]
FloatRows = NDArray[np.float32]

CELLS = 14  # along the longer side, one corner each: 112 at 16:9, of which an affine map and a median need 10
MIN_QUALITY = 0.01  # of the best corner's least eigenvalue: a tenth of its contrast
SOBEL_SCALE = 1.0 / (4 * 3 * 255)  # Sobel's weights (4), the window of 3 px, grey levels from 0 to 1
MIN_EIGENVALUE = 2e-5  # above what noise of two grey levels gives in a blank image reduced to a quarter


def corners(gray: GrayImage) -> PointArray:
    """(N, 2) float32 corners of an (h, w) image, px: at most one a cell, so that they are spread over the image."""
    height, width = gray.shape
    size = max(height, width) // CELLS
    places, quality = _best_of_cells(gray, size)
    return places[quality > max(MIN_QUALITY * float(quality.max()), MIN_EIGENVALUE)]


@njit(cache=True)
def sharpness(gray: GrayImage) -> float:
    """Mean square of the Laplacian of an (h, w) image; comparable between frames of the same content only."""
    height, width = gray.shape
    total = 0
    for y in range(1, height - 1):
        total += _laplacian_squares(gray[y - 1], gray[y], gray[y + 1])
    return total / ((height - 2) * (width - 2))


@njit(cache=True)
def _laplacian_squares(above: GrayImage, here: GrayImage, below: GrayImage) -> np.int32:
    upper, left, middle, right, lower = above[1:-1], here[:-2], here[1:-1], here[2:], below[1:-1]
    total = np.int32(0)  # enough for the 2063 px of a row at the largest Laplacian (1020); reduced rows are shorter
    for x in range(len(middle)):
        edge = np.int32(upper[x]) + np.int32(lower[x]) + np.int32(left[x]) + np.int32(right[x])
        laplacian = np.int32(edge - 4 * np.int32(middle[x]))
        total = np.int32(total + laplacian * laplacian)
    return total


@njit(cache=True)
def _best_of_cells(gray: GrayImage, size: int) -> tuple[PointArray, FloatRows]:
    """Places (N, 2) and least eigenvalues (N,) of the structure tensor's maximum in each cell of `size` px."""
    height, width = gray.shape
    rows, columns = height // size, width // size
    places = np.zeros((rows * columns, 2), np.float32)
    quality = np.zeros(rows * columns, np.float32)
    products = np.zeros((3, 3, width), np.float32)  # of the gradients of three rows: xx, xy, yy
    sums = np.zeros((3, width), np.float32)
    best = np.zeros(width, np.float32)  # of each column, within the cells of this row
    best_row = np.zeros(width, np.int32)
    for y in range(1, min(rows * size + 1, height - 1)):
        _gradient_products(gray[y - 1], gray[y], gray[y + 1], products[y % 3])
        if y < 3:
            continue
        for kind in range(3):
            _sum_rows(products[0, kind], products[1, kind], products[2, kind], sums[kind])
        _keep_better(sums, np.int32(y - 1), best, best_row)
        if y % size == 0 or y == height - 2:
            row = (y - 1) // size
            for column in range(columns):
                cell = row * columns + column
                for x in range(column * size, (column + 1) * size):
                    if best[x] > quality[cell]:
                        quality[cell] = best[x]
                        places[cell, 0], places[cell, 1] = x, best_row[x]
            best[:] = 0
    return places, quality


@njit(cache=True, error_model="numpy")
def _gradient_products(above: GrayImage, here: GrayImage, below: GrayImage, products: FloatRows) -> None:
    """Products (3, width) of the Sobel gradients along a row, scaled."""
    above_left, above_mid, above_right = above[:-2], above[1:-1], above[2:]
    left, right = here[:-2], here[2:]
    below_left, below_mid, below_right = below[:-2], below[1:-1], below[2:]
    xx, xy, yy = products[0][1:-1], products[1][1:-1], products[2][1:-1]
    scale = np.float32(SOBEL_SCALE)
    for x in range(len(left)):
        upper = np.int32(above_right[x]) - np.int32(above_left[x])
        lower = np.int32(below_right[x]) - np.int32(below_left[x])
        middle = np.int32(right[x]) - np.int32(left[x])
        gx = np.float32(upper + 2 * middle + lower) * scale
        falling = np.int32(below_left[x]) - np.int32(above_left[x])
        rising = np.int32(below_right[x]) - np.int32(above_right[x])
        center = np.int32(below_mid[x]) - np.int32(above_mid[x])
        gy = np.float32(falling + 2 * center + rising) * scale
        xx[x] = gx * gx
        xy[x] = gx * gy
        yy[x] = gy * gy


@njit(cache=True, error_model="numpy")
def _sum_rows(first: FloatRows, second: FloatRows, third: FloatRows, total: FloatRows) -> None:
    for x in range(len(total)):
        total[x] = first[x] + second[x] + third[x]


@njit(cache=True, error_model="numpy")
def _keep_better(sums: FloatRows, y: int, best: FloatRows, best_row: NDArray[np.int32]) -> None:
    """Keeps, per column, a row's least eigenvalues where they exceed the best so far."""
    xx, xy, yy = sums[0], sums[1], sums[2]
    left_xx, mid_xx, right_xx = xx[1:-3], xx[2:-2], xx[3:-1]
    left_xy, mid_xy, right_xy = xy[1:-3], xy[2:-2], xy[3:-1]
    left_yy, mid_yy, right_yy = yy[1:-3], yy[2:-2], yy[3:-1]
    best, best_row = best[2:-2], best_row[2:-2]
    half = np.float32(0.5)
    for x in range(len(best)):
        a = half * (left_xx[x] + mid_xx[x] + right_xx[x])
        b = left_xy[x] + mid_xy[x] + right_xy[x]
        c = half * (left_yy[x] + mid_yy[x] + right_yy[x])
        least = (a + c) - np.sqrt((a - c) * (a - c) + b * b)
        before = best[x]
        best_row[x] = y if least > before else best_row[x]
        best[x] = least if least > before else before
