# SPDX-License-Identifier: Apache-2.0
"""Corners of a room and edges of ducts: from one height a line before one looks like it, wherever it lies in depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.thin.depth_from_cloud import covers
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.scene_context import ALONG, CORNER, SceneContext

# The line of sight passes a corner that a line may be by no more than this, in radii: the corner is one of its sides.
_ASIDE = 2.0
# Both planes must be there within this distance of the corner [m], along more than half of it, looked at in such steps.
_BESIDE = 0.05


def is_corner(cylinder: Cylinder, centre: FloatArray, around: SceneContext) -> bool:
    """Whether a thin cylinder, seen from `centre` (3,), looks like the line in which two planes of the cloud meet."""
    for one, other, line in _parallel_corners(cylinder, around):
        if covers(cylinder, line, centre, _ASIDE) and _is_there(one, other, line, around):
            return True
    return False


def _parallel_corners(cylinder: Cylinder, around: SceneContext) -> Iterator[tuple[Plane, Plane, Cylinder]]:
    """The pairs of planes that meet along the cylinder's direction, and its place on the line in which they meet."""
    along = [plane for plane in around.planes if abs(plane.normal @ cylinder.axis) < ALONG]
    for one, other in combinations(along, 2):
        if abs(one.normal @ other.normal) < CORNER:
            direction = np.cross(one.normal, other.normal)
            direction /= np.linalg.norm(direction)
            normals = np.stack([one.normal, other.normal, direction])
            foot = np.linalg.solve(normals, np.array([one.offset, other.offset, direction @ cylinder.middle]))
            start, end = (foot + direction * (direction @ (end - foot)) for end in (cylinder.start, cylinder.end))
            yield one, other, replace(cylinder, start=start, end=end)


def _is_there(one: Plane, other: Plane, line: Cylinder, around: SceneContext) -> bool:
    """Whether both planes have points beside the line in which they meet: far from their points they go on, too."""
    points = around.walls.points[around.walls.near_segment(line.start, line.end, _BESIDE)]
    place = np.floor(line.along(points) / _BESIDE).astype(np.int64)
    from_one, from_other = (np.abs(points @ plane.normal - plane.offset) for plane in (one, other))
    steps = max(int(line.length / _BESIDE), 1)
    clear = around.clearance
    return all(
        len(np.unique(place[(near < clear) & (far > clear)])) > 0.5 * steps
        for near, far in ((from_one, from_other), (from_other, from_one))
    )
