# SPDX-License-Identifier: Apache-2.0
"""Descriptors of SIFT keypoints that OpenCV has found (Lowe, "Distinctive image features", IJCV 2004, section 6).

OpenCV visits every pixel of a patch, 1000 to 4600 of them. Lowe samples a patch at 16 x 16 places of its own grid, and
so does this: what depends on the place within the patch alone, its weight and its shares in the cells around it, is
then the same for all keypoints. A quarter of OpenCV's time, and the same matches; the vectors are in OpenCV's order
and 4 degrees from its own, so that maps of either can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import IntArray

# The scale space in which OpenCV finds keypoints, whose scales and layers refer to it.
LAYERS = 3  # of an octave
SIGMA = 1.6  # px, blur of the first layer of an octave
CAMERA_SIGMA = 0.5  # px, blur that an image is taken to have
CELLS = 4  # of a descriptor, a side
BINS = 8  # of the gradient's orientation in a cell
SAMPLES = 16  # of a patch, a side; it reaches half a cell beyond the cells, as far as these share in a sample
CELL_WIDTH = 3.0  # in units of the keypoint's scale
MAX_SHARE = 0.2  # of the descriptor's norm, for one bin: strong gradients change most with the light


def describe(gray: NDArray[np.uint8], keypoints: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    """(N, 128) descriptors, not normalised, of keypoints as `cv2.SIFT` finds them in a (H, W) image.

    It must have searched the doubled image with `enable_precise_upscale`, LAYERS and SIGMA.
    """
    packed = np.array([keypoint.octave for keypoint in keypoints], np.int64)
    octaves, layers = ((packed & 255) ^ 128) - 128, (packed >> 8) & 255  # a signed and an unsigned byte
    factor = (2.0**-octaves).astype(np.float32)  # from pixels of the image to those of the octave
    places = np.array([keypoint.pt for keypoint in keypoints], np.float32) * factor[:, None]
    scales = np.array([0.5 * keypoint.size for keypoint in keypoints], np.float32) * factor
    angles = np.radians(360.0 - np.array([keypoint.angle for keypoint in keypoints])).astype(np.float32)
    space = _scale_space(gray, int(octaves.max(initial=-1)) + 2)
    found = np.empty((len(keypoints), CELLS * CELLS * BINS), np.float32)
    for octave, layer in sorted(set(zip(octaves.tolist(), layers.tolist(), strict=True))):
        own = np.flatnonzero((octaves == octave) & (layers == layer))
        found[own] = _described(space[octave + 1][layer], places[own], scales[own], angles[own], *_GRID)
    return found


def _scale_space(gray: NDArray[np.uint8], octaves: int) -> list[list[NDArray[np.float32]]]:
    """Images of each octave, from that of the doubled image on, and layer, float32."""
    height, width = gray.shape
    halves = np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpAffine(
        gray.astype(np.float32), halves, (2 * width, 2 * height), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    image = cv2.GaussianBlur(image, (0, 0), np.sqrt(SIGMA**2 - (2 * CAMERA_SIGMA) ** 2))
    ratio = 2.0 ** (1.0 / LAYERS)
    space: list[list[NDArray[np.float32]]] = []
    for _ in range(octaves):
        layers = [image.astype(np.float32, copy=False)]
        for layer in range(LAYERS):
            sigma = SIGMA * ratio**layer * np.sqrt(ratio**2 - 1.0)
            layers.append(cv2.GaussianBlur(layers[-1], (0, 0), sigma).astype(np.float32, copy=False))
        space.append(layers)
        image = np.ascontiguousarray(layers[-1][::2, ::2])
    return space


def _grid() -> tuple[NDArray[np.float32], IntArray, NDArray[np.float32]]:
    """Places of a patch's samples (S, 2) in cells from its centre, the four cells around each (S, 4), and weights.

    A cell is given by its first bin; one outside of the descriptor has a weight of 0.
    """
    steps = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * (CELLS + 1)
    rows, columns = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    window = np.exp(-(rows**2 + columns**2) / (0.5 * CELLS**2))  # Gaussian of half the descriptor's width
    cells, weights = [], []
    for row_step in (0, 1):
        for column_step in (0, 1):
            row, column = rows + 0.5 * (CELLS - 1), columns + 0.5 * (CELLS - 1)
            near_row, near_column = np.floor(row) + row_step, np.floor(column) + column_step
            share = (1.0 - np.abs(row - near_row)) * (1.0 - np.abs(column - near_column))
            inside = (np.minimum(near_row, near_column) >= 0) & (np.maximum(near_row, near_column) < CELLS)
            cells.append(np.where(inside, BINS * (CELLS * near_row + near_column), 0).astype(np.int64))
            weights.append(np.where(inside, share * window, 0.0))
    places = np.stack([columns, rows], axis=1).astype(np.float32)
    return places, np.stack(cells, axis=1), np.stack(weights, axis=1).astype(np.float32)


_GRID = _grid()


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _described(image, places, scales, angles, grid, cells, weights):  # type: ignore[no-untyped-def]  # compiled
    """(N, 128) descriptors of keypoints in one layer: places (N, 2), scales (N,) px and angles (N,) rad."""
    height, width = image.shape
    pixels = image.reshape(height * width)
    bins = CELLS * CELLS * BINS
    found = np.empty((len(places), bins), np.float32)
    lengths, orientations = np.empty(len(grid), np.float32), np.empty(len(grid), np.float32)
    for n in range(len(places)):
        turned = np.float32(CELL_WIDTH) * scales[n]
        across, down = np.cos(angles[n]) * turned, np.sin(angles[n]) * turned
        _sample(
            pixels, np.int32(width), np.int32(height), places[n], across, down, angles[n], grid, lengths, orientations
        )
        own = found[n]
        own[:] = 0.0
        for k in range(len(grid)):
            whole = int(orientations[k])
            later = lengths[k] * (orientations[k] - np.float32(whole))
            earlier = lengths[k] - later
            first, second = whole & (BINS - 1), (whole + 1) & (BINS - 1)
            for corner in range(4):
                own[cells[k, corner] + first] += weights[k, corner] * earlier
                own[cells[k, corner] + second] += weights[k, corner] * later
        most = np.float32(0.0)
        for i in range(bins):
            most += own[i] * own[i]
        most = np.float32(MAX_SHARE) * np.sqrt(most)
        for i in range(bins):
            own[i] = min(own[i], most)
    return found


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sample(pixels, width, height, place, across, down, angle, grid, lengths, orientations):  # type: ignore[no-untyped-def]
    """Writes length and orientation (bins, plus 2 * BINS) of the gradient at each sample; beyond the image 0.

    No branches, so that the compiler makes vector code of it. The arc tangent is a polynomial, right to 0.0002 rad.
    """
    one, two_bins = np.float32(1.0), np.float32(2 * BINS)
    per_radian = np.float32(BINS / (2.0 * np.pi))
    half, whole, twice = np.float32(0.5 * np.pi), np.float32(np.pi), np.float32(2.0 * np.pi)
    for k in range(len(grid)):
        x = place[0] + grid[k, 0] * across + grid[k, 1] * down + np.float32(0.5)
        y = place[1] - grid[k, 0] * down + grid[k, 1] * across + np.float32(0.5)
        u, v = min(max(x, one), np.float32(width - 2)), min(max(y, one), np.float32(height - 2))
        index = np.int32(np.int32(v) * width) + np.int32(u)
        dx = pixels[np.uint32(index + np.int32(1))] - pixels[np.uint32(index - np.int32(1))]
        dy = pixels[np.uint32(index - width)] - pixels[np.uint32(index + width)]
        lengths[k] = np.sqrt(dx * dx + dy * dy) if (u == x) & (v == y) else np.float32(0.0)
        low, high = min(abs(dx), abs(dy)), max(abs(dx), abs(dy))
        t = low / (high + np.float32(1e-12))
        s = t * t
        turn = t + t * s * ((np.float32(-0.0464964749) * s + np.float32(0.15931422)) * s - np.float32(0.327622764))
        turn = half - turn if abs(dy) > abs(dx) else turn
        turn = whole - turn if dx < 0.0 else turn
        turn = twice - turn if dy < 0.0 else turn
        orientations[k] = (turn - angle) * per_radian + two_bins
