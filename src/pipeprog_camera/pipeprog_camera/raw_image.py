# SPDX-License-Identifier: Apache-2.0
"""Images that are not compressed: which encodings of sensor_msgs/Image are taken, and how their bytes are laid out."""

from __future__ import annotations

from pipeprog_camera.errors import InputError

# Encoding -> bytes of one sample, channels.
SAMPLES: dict[str, tuple[int, int]] = {
    "mono8": (1, 1),
    "8UC1": (1, 1),
    "mono16": (2, 1),
    "16UC1": (2, 1),
    "bgr8": (1, 3),
    "8UC3": (1, 3),
    "rgb8": (1, 3),
    "bgra8": (1, 4),
    "8UC4": (1, 4),
    "rgba8": (1, 4),
}


def check_layout(width: int, height: int, encoding: str, step: int, size: int) -> None:
    """Raises InputError where `size` bytes in rows of `step` are no image of that size [px] and encoding."""
    if encoding not in SAMPLES:
        raise InputError(f"images are encoded as {encoding[:40]!r}: publish one of {', '.join(SAMPLES)}")
    sample, channels = SAMPLES[encoding]
    if not height or not width or step < width * channels * sample or size < height * step:
        raise InputError(f"damaged image: {width} x {height} {encoding} with rows of {step} bytes are not {size} bytes")
