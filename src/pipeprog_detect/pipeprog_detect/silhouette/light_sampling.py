# SPDX-License-Identifier: Apache-2.0
"""Light of a keyframe between its pixels, at points and across lines: cubic convolution (Keys, 1981)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray


def _linear_light() -> NDArray[np.float32]:
    """Table from the 256 grey levels of an sRGB image to light, scaled to 0 ... 255 (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    return (255.0 * np.where(level < 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)).astype(np.float32)


# Lens and pixel blur light, not grey levels: in grey levels a bright pipe before a dark wall looks 0.2 px too wide.
LINEAR_LIGHT = _linear_light()
# Slope of the cubic kernel at one pixel from its centre, as OpenCV's INTER_CUBIC has it.
_SLOPE = -0.75
# Positions between two pixels that the weights are tabled for: an edge is moved by less than 0.002 px.
_PHASES = 256


def _cubic_weights() -> NDArray[np.float32]:
    """Weights (_PHASES + 1, 4) of the pixels at -1, 0, 1 and 2 for points from 0 to 1 px after the second."""
    after = np.linspace(0.0, 1.0, _PHASES + 1)[:, None] - np.arange(-1.0, 3.0)
    distance = np.abs(after)
    near = ((_SLOPE + 2.0) * distance - (_SLOPE + 3.0)) * distance**2 + 1.0
    far = _SLOPE * (((distance - 5.0) * distance + 8.0) * distance - 4.0)
    return np.where(distance <= 1.0, near, far).astype(np.float32)


_WEIGHTS = _cubic_weights()


def light_across(
    image: NDArray[np.uint8], pixel: FloatArray, across: FloatArray, along: FloatArray, offsets: FloatArray, lines: int
) -> NDArray[np.float32]:
    """Light (N, Q), 0 to 255, at `offsets` (Q,) times the steps `across` (N, 2) a line through pixel (N, 2).

    It is the mean of `lines` parallels, one step `along` (N, 2) the line apart; steps are about a pixel long. Points
    outside the image repeat its border.
    """
    return _across(image, pixel, across, along, offsets, lines, LINEAR_LIGHT, _WEIGHTS)


def light_at(image: NDArray[np.uint8], pixel: FloatArray) -> NDArray[np.float32]:
    """Light (N,), 0 to 255, at pixel (N, 2); points outside the image repeat its border."""
    return _at(image, pixel, LINEAR_LIGHT, _WEIGHTS)


@njit(cache=True, nogil=True, inline="always")
def _cubic(
    image: NDArray[np.uint8], x: float, y: float, light: NDArray[np.float32], weights: NDArray[np.float32]
) -> np.float32:
    """Light of the image at one point."""
    height, width = image.shape
    x, y = min(max(x, -2.0), width + 1.0), min(max(y, -2.0), height + 1.0)
    left, top = int(np.floor(x)), int(np.floor(y))
    across = weights[int((x - left) * _PHASES + 0.5)]
    down = weights[int((y - top) * _PHASES + 0.5)]
    total = np.float32(0.0)
    if left >= 1 and top >= 1 and left < width - 2 and top < height - 2:
        for r in range(4):
            row = image[top - 1 + r]
            total += down[r] * (
                across[0] * light[row[left - 1]]
                + across[1] * light[row[left]]
                + across[2] * light[row[left + 1]]
                + across[3] * light[row[left + 2]]
            )
        return total
    for r in range(4):
        row = image[min(max(top - 1 + r, 0), height - 1)]
        for c in range(4):
            total += down[r] * across[c] * light[row[min(max(left - 1 + c, 0), width - 1)]]
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _across(
    image: NDArray[np.uint8],
    pixel: FloatArray,
    across: FloatArray,
    along: FloatArray,
    offsets: FloatArray,
    lines: int,
    light: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    """See `light_across`; `light` is the table of grey levels, `weights` that of the cubic kernel."""
    result = np.zeros((len(pixel), len(offsets)), np.float32)
    share = np.float32(1.0 / lines)
    for i in range(len(pixel)):
        right, down = across[i, 0], across[i, 1]
        for line in range(lines):
            shift = line - 0.5 * (lines - 1)
            x, y = pixel[i, 0] + shift * along[i, 0], pixel[i, 1] + shift * along[i, 1]
            for q in range(len(offsets)):
                at = offsets[q]
                result[i, q] += share * _cubic(image, x + at * right, y + at * down, light, weights)
    return result


@njit(cache=True, nogil=True)
def _at(
    image: NDArray[np.uint8], pixel: FloatArray, light: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """See `light_at`."""
    result = np.empty(len(pixel), np.float32)
    for i in range(len(pixel)):
        result[i] = _cubic(image, pixel[i, 0], pixel[i, 1], light, weights)
    return result
