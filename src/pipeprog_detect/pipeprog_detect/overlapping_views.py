# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a rolling shutter that show little beside their neighbours: they came for the camera's motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.view_overlap import in_image, is_shown_beside

# Points of the cloud that tell it: of the 500 or more in an image, to 0.02.
SAMPLE = 4000


def without_overlapping(views: Sequence[tuple[FloatArray, Camera]], points: NDArray[np.floating]) -> list[int]:
    """Numbers of the views of a rolling shutter without those that both neighbours kept show enough of.

    They are denser in time than their overlap asks for: poses between them tell how the camera moves. A detector that
    measures in all of them takes longer, for the same pipes.

    Args:
        views: camera_from_map (4, 4) and calibration of each, in order of time.
        points: of the cloud (N, 3), in the frame of the views [m].
    """
    some = points[:: max(len(points) // SAMPLE, 1)].astype(float)
    kept: list[int] = []
    for number, seen in enumerate(in_image(some, views)):
        is_between = bool(kept) and number + 1 < len(views)
        if not is_between or not is_shown_beside(some[seen], views[kept[-1]], views[number + 1]):
            kept.append(number)
    return kept
