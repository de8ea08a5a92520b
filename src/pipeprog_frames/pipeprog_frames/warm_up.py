# SPDX-License-Identifier: Apache-2.0
"""What frames need is compiled when a node starts: the first image after an installation would wait for 8 s."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_frames.corners import sharpness
from pipeprog_frames.tracker import Tracker

_WIDTH, _HEIGHT, _FOCAL = 320, 180, 230.0  # px, of a reduced image


def warm_up() -> None:
    """Compiles, or reads what was compiled before (0.3 s); once it is there this takes a millisecond."""
    gray = np.random.default_rng(0).integers(0, 256, (_HEIGHT, _WIDTH), np.uint8)
    sharpness(gray)
    tracker = Tracker(Camera(_WIDTH, _HEIGHT, _FOCAL, _FOCAL, 0.5 * _WIDTH, 0.5 * _HEIGHT))
    tracker.start(gray)
    tracker.track(gray)


if __name__ == "__main__":
    warm_up()
