# SPDX-License-Identifier: Apache-2.0
"""Walls that reach past an axis on its way, such as the sides of a pillar."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.extension import HIDDEN
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.scene import Scene, viewing_direction
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.planes_met import LEAST_POINTS, ON_PLANE, SAME_PLANE, distance_to, points_on
from pipeprog_detect.verification.scene_context import SceneContext


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
        place = distance_to(plane, cylinder.start, cylinder.axis)
        # At its ends it may run into a wall. Small planes are pieces of large ones, whose position they tell worse.
        if place is None or not cylinder.radius < place < cylinder.length - cylinder.radius:
            continue
        if any(abs(place - other) < SAME_PLANE for other in across):
            continue
        behind = points_on(plane.normal, cylinder.start + place * cylinder.axis, context) @ towards
        if min((behind > ON_PLANE).sum(), (behind < -ON_PLANE).sum()) >= LEAST_POINTS:
            across.append(place)
    return sorted(across)
