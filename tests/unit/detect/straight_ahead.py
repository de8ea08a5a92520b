# SPDX-License-Identifier: Apache-2.0
"""Views straight ahead, from places in a row, and thin pipes across them."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.types import Cylinder, View

CAMERA = Camera(480, 270, 345.0, 345.0, 239.5, 134.5)


def looking_along_y(x: float, stamp: int) -> View:
    """A view of nothing from (x, -1.2, 0)."""
    pose = np.eye(4)
    pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, -1.2, 0.0])
    return View(stamp, np.full((CAMERA.height, CAMERA.width), 90, np.uint8), CAMERA, pose)


def level(length: float, slope: float = 0.0, turn: float = 0.0) -> Cylinder:
    """A cylinder along x whose end lies `slope` [rad] towards the cameras and `turn` [rad] higher."""
    axis = np.array([1.0, -np.tan(slope), np.tan(turn)])
    half: FloatArray = 0.5 * length * axis / np.linalg.norm(axis)
    return Cylinder(-half, half, 0.0086)
