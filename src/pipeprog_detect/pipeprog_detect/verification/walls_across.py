# SPDX-License-Identifier: Apache-2.0
"""Walls that reach past an axis on its way, such as the sides of a pillar, and those that close around it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.refinement.extension import HIDDEN
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.scene import Scene, viewing_direction
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.scene_context import SceneContext

# An axis meets a plane at more than 30 deg, or it runs along it.
MEETS = 0.5
# A plane exists at a position where at least this many of its points, nearer to it than the first distance [m], lie
# within the second [m]: what hides a pipe's end hides the floor beside it, too.
ON_PLANE, NEAR, LEAST_POINTS = 0.01, 0.5, 10
# Planes that an axis meets within this distance [m] are one.
SAME_PLANE = 0.05
# A plane surrounds a pipe that passes it where its points lie in six of the eight sectors around the pipe, and no
# farther than this from it [radii, m].
SECTORS, CLOSED, CLOSE_RADII, CLOSE = 8, 6, 4.0, 0.05


def stretches_in_walls(
    cylinder: Cylinder, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> list[tuple[float, float]]:
    """Stretches (from, to) [m from the start] without a contour between two walls across the cylinder.

    Or between one and an end, as far as a pipe may have grown behind what hides it.
    """
    walls = walls_across(cylinder, context, viewing_direction(cylinder, views)) if views else []
    if not walls:
        return []
    bounds = [0.0, *walls, cylinder.length]
    within = [
        (low, high) for low, high in pairwise(bounds) if (low > 0.0 and high < cylinder.length) or high - low < HIDDEN
    ]
    return [each for each in within if Scene.of(cylinder.cut(*each), views, others).support().share < MIN_SUPPORT]


def walls_across(cylinder: Cylinder, context: SceneContext, towards: FloatArray) -> list[float]:
    """Where planes cross the cylinder between its ends, in order [m from its start].

    They are seen both before its axis and behind it, looked at along `towards` (3,): what only stands before the
    cylinder, such as a duct, has no points behind its axis.
    """
    across: list[float] = []
    for plane in sorted(context.planes, key=lambda plane: -plane.area):
        slope = float(plane.normal @ cylinder.axis)
        if abs(slope) < MEETS:
            continue
        place = float(plane.offset - plane.normal @ cylinder.start) / slope
        # At its ends it may run into a wall. Small planes are pieces of large ones, whose position they tell worse.
        is_between = cylinder.radius < place < cylinder.length - cylinder.radius
        if not is_between or any(abs(place - other) < SAME_PLANE for other in across):
            continue
        behind = points_on(plane.normal, cylinder.start + place * cylinder.axis, context) @ towards
        if min((behind > ON_PLANE).sum(), (behind < -ON_PLANE).sum()) >= LEAST_POINTS:
            across.append(place)
    return sorted(across)


def points_on(normal: FloatArray, place: FloatArray, context: SceneContext) -> FloatArray:
    """Points (N, 3) of a plane about a `place` (3,) on it, given from there [m]."""
    thick = ON_PLANE * normal
    return np.asarray(context.walls.points[context.walls.near_segment(place - thick, place + thick, NEAR)] - place)


def surrounds(offset: FloatArray, axis: FloatArray, radius: float) -> bool:
    """Whether points (N, 3), given from where the axis passes, lie close to the pipe on most of its sides."""
    u, v = basis(axis)
    x, y = offset @ u, offset @ v
    close = np.hypot(x, y) < CLOSE_RADII * radius + CLOSE
    sector = ((np.arctan2(y[close], x[close]) / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    return len(np.unique(sector)) >= CLOSED
