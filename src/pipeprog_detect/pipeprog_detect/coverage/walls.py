# SPDX-License-Identifier: Apache-2.0
"""Which parts of a site's walls were in view well enough to show pipes of each radius before them, in square metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import local_shape, octree, plane_segmentation
from pipeprog_detect.coverage.places import Sight, sights
from pipeprog_detect.types import View

# Side of the squares that walls are asked for [m]: about that of the widest pipes, which must show in one.
SQUARE = 0.2
# A wall bounds the site: at most this share of the cloud lies further behind it than this [m]; strays do.
BEHIND_SHARE, BEHIND = 0.02, 0.15
LEAST_AREA = 1.0  # m2; smaller planes are those of ducts, boxes and columns
# Points of a wall lie within this distance of its plane [m]: plaster is even to a centimetre, the rest is noise.
ON_PLANE = 0.03
# Points that planes are sought in: 40 in each cell of 6 cm of 100 m2.
MOST_POINTS = 1_000_000
EDGE = 0.5  # % of a wall's points left out at each of its edges, as strays


@dataclass(frozen=True)
class WallCoverage:
    """Walls, floor and ceiling that were found: their area between their outermost points, and what was seen of it.

    Attributes:
        area: [m2]; walls that no keyframe shows are not known and not counted.
        seen: area [m2] for each radius in which a pipe of it would have been seen.
        hidden: area [m2] for each radius that something hides.
    """

    area: float
    seen: list[float]
    hidden: list[float]


def wall_coverage(points: FloatArray, radii: Sequence[float], views: Sequence[View]) -> WallCoverage:
    """The coverage of the walls in a cloud's points (N, 3) by keyframes with depths (`occlusion.with_depths`)."""
    squares = _squares(points[:: max(-(-len(points) // MOST_POINTS), 1)], np.array([view.centre for view in views]))
    area = SQUARE**2
    seen, hidden = [], []
    for radius in radii:
        places = squares[:, 0] + radius * squares[:, 1]  # of the axis of a pipe that touches the wall
        told = sights(places, np.full(len(places), radius), views)
        seen.append(area * float((told <= Sight.OPEN).sum()))
        hidden.append(area * float((told == Sight.HIDDEN).sum()))
    return WallCoverage(area * len(squares), seen, hidden)


def _squares(points: FloatArray, cameras: FloatArray) -> FloatArray:
    """Middles and unit normals towards the cameras (N, 2, 3) of the squares of all walls."""
    none = np.zeros((0, 2, 3))
    if len(points) < 1000 or not len(cameras):
        return none
    tree = octree.build(points)
    planes, _ = plane_segmentation.find_planes(tree, local_shape.estimate_noise(tree), 0.15)
    found: list[FloatArray] = [none]
    walls: list[tuple[FloatArray, float]] = []
    for plane in sorted((plane for plane in planes if plane.area >= LEAST_AREA), key=lambda plane: -plane.area):
        sign = 1.0 if np.median(cameras @ plane.normal) >= plane.offset else -1.0
        normal, offset = sign * plane.normal, sign * plane.offset
        height = points @ normal - offset
        known = any(normal @ other > 0.95 and abs(offset - at) < BEHIND for other, at in walls)
        if known or (height < -BEHIND).mean() > BEHIND_SHARE:
            continue
        walls.append((normal, offset))
        found.append(_squares_of(points[np.abs(height) < ON_PLANE], normal, offset))
    return np.concatenate(found)


def _squares_of(points: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """Squares (N, 2, 3) of the rectangle around a wall's points (N, 3), level where the wall stands."""
    first = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(first) < 0.5:  # floor or ceiling
        first = np.cross([0.0, 1.0, 0.0], normal)
    first = first / np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)])
    low, high = np.percentile(points @ axes.T, [EDGE, 100.0 - EDGE], axis=0)
    columns, rows = (np.arange(a + 0.5 * SQUARE, max(b, a + SQUARE), SQUARE) for a, b in zip(low, high, strict=True))
    flat = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    middles = flat @ axes + offset * normal
    return np.stack([middles, np.broadcast_to(normal, middles.shape)], axis=1)
