# SPDX-License-Identifier: Apache-2.0
"""Rods that hold trays, ducts and pipes: as thin as a thin pipe, from a wall or ceiling to what they carry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.acceptance import THICKEST_LINE
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.planes_met import MEETS

# Rods are at most this long [m]: racks hang below a ceiling, not amid a room. Pipes of this length that come out of a
# wall end in the open, or in a pipe.
LONGEST = 1.0
# What a rod carries begins at most this far inside of its end [m] (a clamp's or a rail's height), and at most this far
# beyond it: what lies on the rail, up to a pipe of DN100 (0.114 m), hides the rod's last part from those below.
INSIDE, BEYOND = 0.08, 0.16
# It is wider than the rod: beyond what stereo spreads of that, two radii, this many points of the cloud lie within 3 cm
# of the axis. A surface with a point in each square of 3 mm has two hundred in this ring. An edge crosses a quarter:
# where 50 are expected, 29 are there in all but one of a thousand cases (three standard deviations).
WIDER, ASIDE, LEAST_POINTS = 2.0, 0.03, 29


def is_hanger(measured: MeasuredPipe, points: NDArray[np.floating], walls: Sequence[Plane]) -> bool:
    """Whether a thin line runs from a wall or ceiling to a surface in the cloud (N, 3) that stands in its way.

    A rod whose end no image reaches may hang from the ceiling there: pipes that end at what they cross are rarer.
    """
    cylinder = measured.cylinder
    if cylinder.radius >= THICKEST_LINE or cylinder.length > LONGEST:
        return False
    held = [
        state.state in ("wall", "out_of_view") or _is_at_wall(end, cylinder, walls)
        for end, state in zip((cylinder.start, cylinder.end), measured.ends, strict=True)
    ]
    if sum(held) != 1:
        return False
    end, out = (cylinder.end, cylinder.axis) if held[0] else (cylinder.start, -cylinder.axis)
    near = points[(np.abs(points - end) < BEYOND + ASIDE).all(axis=1)]
    aside, along = np.linalg.norm(cylinder.from_axis(near), axis=1), (near - end) @ out
    across = (aside > WIDER * cylinder.radius) & (aside < ASIDE) & (along > -INSIDE) & (along < BEYOND)
    return int(across.sum()) >= LEAST_POINTS


def _is_at_wall(end: FloatArray, cylinder: Cylinder, walls: Sequence[Plane]) -> bool:
    """Whether an end (3,) lies within a diameter of a wall that the cylinder meets: its rim is seen before the wall."""
    return any(
        abs(float(wall.normal @ cylinder.axis)) > MEETS
        and abs(float(wall.normal @ end) - wall.offset) < 2.0 * cylinder.radius
        for wall in walls
    )
