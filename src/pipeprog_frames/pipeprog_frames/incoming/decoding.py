# SPDX-License-Identifier: Apache-2.0
"""Decodes images at the reduced size that the tracker needs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

GrayImage = NDArray[np.uint8]

# px; enough for a hundred corners. A JPEG at 1/4 or 1/8 of its size costs little beyond its entropy decoding.
WORKING_WIDTH = 320
REDUCED = {
    1: cv2.IMREAD_GRAYSCALE,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}


def reduction(width: int) -> int:
    """Factor (1, 2, 4 or 8) by which an image of this width is reduced: the largest that leaves WORKING_WIDTH."""
    return max((factor for factor in REDUCED if width // factor >= WORKING_WIDTH), default=1)


def reduced_size(width: int, height: int) -> tuple[int, int]:
    """Width and height after reduction."""
    factor = reduction(width)
    return -(-width // factor), -(-height // factor)


def is_cut_off(encoded: bytes) -> bool:
    """Whether the encoded image is empty or a JPEG without its end, which the decoder would fill with grey silently."""
    return not encoded or (encoded.startswith(b"\xff\xd8") and b"\xff\xd9" not in encoded[-64:])


def decode_reduced(encoded: bytes, width: int) -> GrayImage | None:
    """(h, w) grey image of the JPEG or PNG bytes of an image `width` px wide; None where they are damaged.

    An EXIF rotation is ignored, since the calibration is for the image as stored.
    """
    flags = REDUCED[reduction(width)] | cv2.IMREAD_IGNORE_ORIENTATION
    return None if is_cut_off(encoded) else cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)


def reduce_image(image: NDArray[np.uint8]) -> GrayImage:
    """(h, w) grey image of a raw (H, W) grey or (H, W, 3) BGR one."""
    size = reduced_size(image.shape[1], image.shape[0])
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return small if small.ndim == 2 else cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
