# SPDX-License-Identifier: Apache-2.0
"""The directions that pipes of a site have in common: racks, risers and what crosses them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Pipes are installed parallel, to a standard deviation of 0.3 deg: at least three within 5 deg of one direction tell it
# (two may be so by chance).
NEARLY_PARALLEL, PARALLEL_SIGMA, LEAST_PARALLEL = np.radians(5.0), np.radians(0.3), 3


def parallel_directions(known: Sequence[Cylinder]) -> list[FloatArray]:
    """The directions (3,) that at least `LEAST_PARALLEL` of the cylinders have, those of the longest ones first."""
    groups: list[list[Cylinder]] = []
    for cylinder in sorted(known, key=lambda each: -each.length):
        near = [group for group in groups if abs(group[0].axis @ cylinder.axis) > np.cos(NEARLY_PARALLEL)]
        if near:
            near[0].append(cylinder)
        else:
            groups.append([cylinder])
    directions = []
    for group in groups:
        if len(group) >= LEAST_PARALLEL:
            axes = np.array([each.axis * np.sign(each.axis @ group[0].axis) for each in group])
            middle = np.median(axes, axis=0)
            directions.append(np.asarray(middle / np.linalg.norm(middle), np.float64))
    return directions
