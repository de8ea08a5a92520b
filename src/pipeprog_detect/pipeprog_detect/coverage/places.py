# SPDX-License-Identifier: Apache-2.0
"""Whether pipes at given places would have been seen: what the keyframes show before, at and behind each place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import NEAR_PLANE, project
from pipeprog_detect.silhouette.free_space import MIN_SHARE, MIN_VIEWS
from pipeprog_detect.silhouette.occlusion import BEFORE
from pipeprog_detect.thin.pair_views import WIDTH_SIGMA
from pipeprog_detect.types import View

# Half of the width [px] at which a pipe is still told from a line: three standard deviations of a segment pair's width
# make the whole width. Further away, or smaller, the detector has nothing to go by.
LEAST_HALF_WIDTH = 0.5 * 3.0 * WIDTH_SIGMA


class Sight(IntEnum):
    """What the keyframes tell of a place where a pipe may be."""

    EMPTY = 0  # they see through it: no pipe is there
    OPEN = 1  # nothing lies before it, but they do not see through it: a pipe may be there, or be too thin to tell
    HIDDEN = 2  # something lies before it
    NOT_SEEN = 3  # fewer than three keyframes have it in the image, large enough and with a depth behind


@dataclass(frozen=True)
class _Counts:
    """Number of keyframes (N,) that tell each thing of N places."""

    through: NDArray[np.int64]
    unproven: NDArray[np.int64]  # as through, but where the pipe is thinner than what the depths resolve
    at: NDArray[np.int64]
    hidden: NDArray[np.int64]
    without_depth: NDArray[np.int64]


def sights(places: FloatArray, radii: FloatArray, views: Sequence[View]) -> NDArray[np.int8]:
    """A `Sight` (N,) for each of the places (N, 3) of the axis of a pipe of radius (N,) [m].

    `views`: the keyframes with the depths of the nearest surfaces (`occlusion.with_depths`); their images are not used.
    """
    counts = _counted(places, radii, views)
    free = counts.through + counts.unproven + counts.at
    result = np.full(len(places), Sight.NOT_SEEN, np.int8)
    enough = free + counts.hidden + counts.without_depth >= MIN_VIEWS
    result[enough & (counts.hidden > counts.without_depth)] = Sight.HIDDEN
    result[free >= MIN_VIEWS] = Sight.OPEN
    result[(counts.through >= MIN_VIEWS) & (counts.through > MIN_SHARE * free)] = Sight.EMPTY
    return result


def _counted(places: FloatArray, radii: FloatArray, views: Sequence[View]) -> _Counts:
    counts = np.zeros((5, len(places)), np.int64)
    for view in views:
        if view.nearest is None:
            continue
        camera, cell = view.camera, view.camera.width / view.nearest.shape[1]
        pixel, depth = project(view, places)
        inside = (pixel >= 0).all(axis=1) & (pixel <= [camera.width - 1, camera.height - 1]).all(axis=1)
        inside &= (depth > NEAR_PLANE) & (camera.fx * radii >= LEAST_HALF_WIDTH * depth)
        rows = np.flatnonzero(inside)
        row, column = (pixel[rows, ::-1] / cell).astype(np.int64).T
        row, column = (np.minimum(at, most - 1) for at, most in zip((row, column), view.nearest.shape, strict=True))
        nearest, own, radius = view.nearest[row, column], depth[rows], radii[rows]
        # The front of a pipe lies one radius before its axis; what lies behind the axis, and behind the front by more
        # than the depths are wrong, is no part of it.
        behind = nearest > own + np.maximum(BEFORE - radius, 0.0)
        resolved = camera.fx * radius > cell * own
        known = np.isfinite(nearest)
        before = nearest < own - radius - BEFORE
        told = (behind & known & resolved, behind & known & ~resolved, ~behind & ~before, before, ~known)
        for count, mask in zip(counts, told, strict=True):
            count[rows[mask]] += 1
    return _Counts(*counts)
