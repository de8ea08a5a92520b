# SPDX-License-Identifier: Apache-2.0
"""The pipe and the wall of `pipe_views`, as points."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

PIPE = Cylinder(np.array([0.01, 0.0, -0.2]), np.array([-0.01, 0.01, 0.2]), 0.04)
WALL = 0.12  # y [m]


def wall_points() -> FloatArray:
    x, z = np.meshgrid(np.arange(-0.8, 0.8, 0.005), np.arange(-0.5, 0.5, 0.005))
    return np.stack([x.ravel(), np.full(x.size, WALL), z.ravel()], axis=1)


def front_points(cylinder: Cylinder) -> FloatArray:
    """The half of the barrel that faces -y."""
    angle, along = np.meshgrid(np.linspace(-1.3, 1.3, 30), np.arange(0.0, cylinder.length, 0.004))
    side = np.cross(cylinder.axis, [0.0, -1.0, 0.0])
    radial = np.cos(angle)[..., None] * np.array([0.0, -1.0, 0.0]) + np.sin(angle)[..., None] * side
    return (cylinder.start + along[..., None] * cylinder.axis + cylinder.radius * radial).reshape(-1, 3)


def barrel_depth(cylinder: Cylinder, centre: FloatArray, rays: FloatArray) -> FloatArray:
    """Where rays (..., 3) from `centre` (..., 3) meet the barrel first, in lengths of the ray; infinite if nowhere."""
    axis = cylinder.axis
    offset = centre - cylinder.start
    across = rays - (rays @ axis)[..., None] * axis
    offset_across = offset - (offset @ axis)[..., None] * axis
    a, b = (across**2).sum(-1), (across * offset_across).sum(-1)
    root = b**2 - a * ((offset_across**2).sum(-1) - cylinder.radius**2)
    depth = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    along = offset @ axis + depth * (rays @ axis)
    return np.where((root > 0.0) & (along > 0.0) & (along < cylinder.length), depth, np.inf)
