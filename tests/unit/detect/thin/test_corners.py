# SPDX-License-Identifier: Apache-2.0
"""Thin lines that look like the corner of two walls, and pipes before one."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.thin.corners import is_corner
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.scene_context import SceneContext

RADIUS = 0.0086
CENTRE = np.array([0.0, -2.0, 1.2])
WALL, FLOOR = Plane(np.array([0.0, 1.0, 0.0]), 0.0, 4.0), Plane(np.array([0.0, 0.0, 1.0]), 0.0, 4.0)


def room(floor_from: float = 0.0) -> SceneContext:
    """A wall at y = 0 and the floor z = 0, which reaches it, or ends `floor_from` [m] before it."""
    rng = np.random.default_rng(0)
    wall, floor = (rng.uniform([-1.0, -2.0, 0.0], [1.0, 0.0, 2.0], (40_000, 3)) for _ in range(2))
    wall[:, 1], floor[:, 2] = 0.0, 0.0
    floor = floor[floor[:, 1] < -floor_from]
    points = octree.build(np.concatenate([wall, floor]) + rng.normal(0.0, 5e-4, (len(wall) + len(floor), 3)))
    return SceneContext(points, None, [WALL, FLOOR], points, 5e-4)


def before_corner(nearer: float, aside: float, tilt: float = 0.0) -> Cylinder:
    """A cylinder along x that from CENTRE is seen `aside` radii beside the corner, `nearer` [m] than that."""
    sight = -CENTRE / np.linalg.norm(CENTRE)
    across = np.cross([1.0, 0.0, 0.0], sight)
    middle = -nearer * sight + aside * RADIUS * across
    half: FloatArray = 0.5 * np.array([1.0, 0.0, 0.0]) + 0.5 * np.tan(tilt) * across
    return Cylinder(middle - half, middle + half, RADIUS)


@pytest.mark.parametrize("nearer", [0.0, 0.1, 0.4])
def test_a_line_before_the_corner_looks_like_it_at_any_depth(nearer: float) -> None:
    assert is_corner(before_corner(nearer, 1.0), CENTRE, room())


@pytest.mark.parametrize(("aside", "tilt"), [(3.0, 0.0), (-3.0, 0.0), (0.0, np.radians(4.0)), (0.0, np.radians(20.0))])
def test_a_pipe_beside_the_corner_or_across_it_is_none(aside: float, tilt: float) -> None:
    assert not is_corner(before_corner(0.1, aside, tilt), CENTRE, room())


def test_planes_that_do_not_reach_each_other_make_no_corner() -> None:
    assert not is_corner(before_corner(0.1, 0.0), CENTRE, room(floor_from=0.1))
