# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a rolling shutter that show little beside their neighbours: they came for the camera's motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.view_overlap import in_image
from pipeprog_detect.types import View

# Share of what a keyframe shows that the ones before and after it must show as well: as much as keyframes of a global
# shutter overlap, where none is chosen for the motion (frames.overlap_min).
OVERLAP = 0.85
# Points of the cloud that tell it: of the 500 or more in an image, to 0.02.
SAMPLE = 4000


def without_overlapping(views: Sequence[View], points: FloatArray) -> list[View]:
    """The views, in order of time; of a rolling shutter without those that both neighbours kept show enough of.

    Keyframes of a rolling shutter are denser in time than their overlap asks for: poses between them tell how the
    camera moves. A detector measures in each of them, for little more than in every other one.

    points (N, 3): of the cloud, in the frame of the views [m].
    """
    if any(view.rolled is None for view in views):
        return list(views)
    ordered = sorted(views, key=lambda view: view.stamp)
    some = points[:: max(len(points) // SAMPLE, 1)]
    seen = in_image(some, [(view.camera_from_map, view.camera) for view in ordered])
    kept: list[int] = []
    for number in range(len(ordered)):
        if kept and number + 1 < len(ordered):
            both = seen[kept[-1]] & seen[number + 1]
            if np.count_nonzero(both & seen[number]) >= OVERLAP * max(np.count_nonzero(seen[number]), 1):
                continue
        kept.append(number)
    return [ordered[number] for number in kept]
