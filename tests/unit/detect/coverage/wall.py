# SPDX-License-Identifier: Apache-2.0
"""A wall two metres from nine cameras, and a curtain before a part of it."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.types import Cylinder

CAMERA = Camera(1280, 720, 914.0, 914.0, 639.5, 359.5)
LOOKING_ALONG_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
CURTAIN = (0.6, 1.4)  # m, along x, 0.3 m before the wall
RADIUS = 0.05


def sheet(x: tuple[float, float], y: float, seed: int = 0) -> FloatArray:
    """Points of a sheet across the view, 3 mm rough."""
    random = np.random.default_rng(seed)
    count = int(30_000 * (x[1] - x[0]))
    return np.c_[random.uniform(*x, count), random.normal(y, 0.003, count), random.uniform(-1, 1, count)]


def poses() -> FloatArray:
    """Cameras at y = 0 from x = -1 to 1 that look along y."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = LOOKING_ALONG_Y
    poses[:, 0, 3] = np.linspace(-1, 1, 9)
    return poses


def wall_and_curtain() -> FloatArray:
    """Points of both."""
    return np.concatenate([sheet((-2.4, 2.4), 2.0), sheet(CURTAIN, 1.7, 1)])


def upright(x: float, radius: float = RADIUS, y: float | None = None) -> Cylinder:
    """A pipe before the wall, half a metre up and down."""
    depth = 2.0 - radius - 0.05 if y is None else y
    return Cylinder(np.array([x, depth, -0.4]), np.array([x, depth, 0.4]), radius)
