# SPDX-License-Identifier: Apache-2.0
"""Planes that an axis meets: where, what is seen of them there, and whether they close around a pipe."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.types import Cylinder
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
# A plane across the end of a pipe (cosine of 10 deg) is that end, a cap or what stereo makes of an opening, where it is
# not larger than this many of the pipe's cross-sections: stereo spreads its edge by two centimetres.
ACROSS, END_AREAS = float(np.cos(np.radians(10.0))), 2.0


def distance_to(plane: Plane, place: FloatArray, direction: FloatArray) -> float | None:
    """How far [m] from a `place` (3,) an axis of unit `direction` (3,) meets a plane; None where it runs along it."""
    slope = float(plane.normal @ direction)
    if abs(slope) < MEETS:
        return None
    return float(plane.offset - plane.normal @ place) / slope


def is_end_of(plane: Plane, cylinder: Cylinder) -> bool:
    """Whether a plane is no wall but what is seen of a cylinder's end."""
    if abs(plane.normal @ cylinder.axis) < ACROSS or plane.area > END_AREAS * np.pi * cylinder.radius**2:
        return False
    return any(abs(plane.normal @ end - plane.offset) < SAME_PLANE for end in (cylinder.start, cylinder.end))


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
