# SPDX-License-Identifier: Apache-2.0
"""Frames in which nothing can be measured, however often they are filmed: blurred, flat, over-exposed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_sfm.boards.ellipses import MAX_BLUR, MIN_CONTRAST

# px; at this size its two re-blurred copies take 20 ms, and a camera's blur is much the same over the image
_LOOKED_AT = 1280
_SMOOTH, _SMOOTHER = 1.0, 2.0  # px, standard deviations that edges are smoothed by: below the blurs to be told, above
_STEEPEST = 1000  # pixels for each one on the steepest edges: 920 of these at 720p, the rim of one circle of a board
_WHITE = 254  # of 255; what is clipped, less JPEG's rounding
_CLIPPED = 0.5  # of a frame: two neighbours that overlap by half have nothing in common then

REMEDIES = {
    "blurred": (
        f"blurred: edges spread by more than the {MAX_BLUR} px within which the circles of boards and the outlines of "
        "pipes are measured; focus on the pipes, walk more slowly, or add light"
    ),
    "flat": (
        f"too dark or too flat: less than the {MIN_CONTRAST:.0f} grey levels between dark and bright that the circles "
        "of boards must have; add light, or expose for longer"
    ),
    "overexposed": "white without detail for the most part: expose for less, or turn away from the light",
}


def blur(gray: NDArray[np.uint8]) -> float:
    """Standard deviation [px] of the blur of the steepest edges of an (H, W) image, of the worse direction.

    An edge that is blurred further loses steepness by a factor that tells how blurred it was (Zhuo and Sim, Pattern
    Recognition 2011); it does so whatever its contrast. Blurs of more than some 4 px are told as less.
    """
    middle = _middle(gray).astype(np.float32)
    copies = [cv2.GaussianBlur(middle, (0, 0), sigma) for sigma in (_SMOOTH, _SMOOTHER)]
    return max(_blur_along(axis, *copies) for axis in ((1, 0), (0, 1)))


def contrast(gray: NDArray[np.uint8]) -> float:
    """Grey levels between the darkest and the brightest hundredth of an image."""
    dark, bright = np.percentile(_middle(gray), (1.0, 99.0))
    return float(bright - dark)


def clipped(gray: NDArray[np.uint8]) -> float:
    """The share of an image that is white without detail."""
    return float((gray >= _WHITE).mean())


def fault_of(gray: NDArray[np.uint8]) -> str:
    """What keeps circles and outlines from being measured in an (H, W) image, a key of REMEDIES; empty: nothing."""
    if clipped(gray) > _CLIPPED:
        return "overexposed"
    if contrast(gray) < MIN_CONTRAST:
        return "flat"
    return "blurred" if blur(gray) > MAX_BLUR else ""


def _middle(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    top, left = (max(0, (size - _LOOKED_AT) // 2) for size in gray.shape)
    return gray[top : top + _LOOKED_AT, left : left + _LOOKED_AT]


def _blur_along(axis: tuple[int, int], smooth: NDArray[np.float32], smoother: NDArray[np.float32]) -> float:
    """0 where there is no edge across `axis`, or noise alone."""
    steep, less = (np.abs(cv2.Sobel(image, cv2.CV_32F, *axis)).ravel() for image in (smooth, smoother))
    count = max(len(less) // _STEEPEST, 1)
    edges = np.argpartition(less, -count)[-count:]  # of the smoother copy: it has less noise
    if not steep[edges].all():
        return 0.0
    ratio = float(np.median(less[edges] / steep[edges]))  # squared: (blur^2 + 1^2) / (blur^2 + 2^2)
    if ratio >= 1.0:
        return float("inf")
    variance = (ratio**2 * _SMOOTHER**2 - _SMOOTH**2) / (1.0 - ratio**2)
    return float(np.sqrt(max(variance, 0.0)))
