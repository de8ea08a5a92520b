# SPDX-License-Identifier: Apache-2.0
"""What footage gives, whatever its format: pictures with their stamps and, where the phone has told them, poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError

# Stamp of the first image [ns] where footage has no date: zero means "not set" in ROS.
UNDATED = 1_000_000_000


@dataclass(frozen=True)
class Shot:
    """One picture: stamp [ns], the picture, the camera that took it, and what the phone measured beside it.

    Attributes:
        picture: JPEG as it was filmed, or (H, W, 3) BGR.
        world_from_camera: (4, 4); z of the world up, camera as in REP-103's optical frames (x right, y down, z ahead).
        depth: (H, W) uint16 [mm], 0 where there is none; smaller than the picture, and of the same view.
        confidence: (H, W) uint8 of the depth, 0 to 2.
    """

    stamp: int
    picture: bytes | NDArray[np.uint8]
    camera: Camera
    world_from_camera: FloatArray | None = None
    depth: NDArray[np.uint16] | None = None
    confidence: NDArray[np.uint8] | None = None


class Footage(Protocol):
    """A source of shots."""

    path: Path
    expected: int  # shots, as far as the container tells; 0: not at all
    notes: list[str]  # sentences for the user; complete once the shots were taken

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The wanted pictures in the order of their times; raises InputError where the footage cannot be used."""
        ...


class Excerpt:
    """Which pictures are wanted: from `start` to `end` [s of the footage], at most `rate` a second; asked in order."""

    def __init__(self, start: float = 0.0, end: float = math.inf, rate: float | None = None) -> None:
        if not 0.0 <= start < end:
            raise InputError(f"--start {start:g} --end {end:g}: give seconds of the video, the end after the start")
        if rate is not None and not 0.0 < rate < math.inf:
            raise InputError(f"--fps {rate:g}: give images a second, above zero")
        self._start, self._end = start, end
        self._step = 0.0 if rate is None else 1.0 / rate
        self._due = start

    def wants(self, seconds: float) -> bool:
        """Whether the picture at this time is wanted; it then counts as taken."""
        if not self._due - 1e-3 <= seconds <= self._end or seconds < self._start:
            return False
        # Where pictures come later than they are due, the next one is not due earlier for it.
        self._due = max(self._due + self._step, seconds - 0.5 * self._step)
        return True

    def is_over(self, seconds: float) -> bool:
        """Whether no later picture is wanted."""
        return seconds > self._end
