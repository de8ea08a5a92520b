# SPDX-License-Identifier: Apache-2.0
"""Outlines of measured pipes in the keyframes: the line around what a camera sees of a cylinder, and its pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_detect.types import Cylinder

NEAR = 0.05  # m; nearer to the camera nothing is projected
POSITIONS = 25  # along an axis: a lens bends the line between two by less than a pixel


def outline(cylinder: Cylinder, centre: FloatArray) -> FloatArray:
    """(N, 3) closed line around what a camera at `centre` (3,) sees of a cylinder [m]; empty from inside it."""
    towards = cylinder.from_axis(centre[None])[0]
    distance = float(np.linalg.norm(towards))
    if distance <= cylinder.radius:
        return np.empty((0, 3))
    near = towards / distance
    aside = np.cross(cylinder.axis, near)
    # The surface turns away from the camera where its normal is at right angles to the line of sight.
    turn = math.acos(cylinder.radius / distance)
    line = cylinder.at(np.linspace(0.0, 1.0, POSITIONS))
    sides = [cylinder.radius * (math.cos(turn) * near + sign * math.sin(turn) * aside) for sign in (1.0, -1.0)]
    return np.concatenate([line + sides[0], line[::-1] + sides[1]])


def project(
    camera: Camera, pose: FloatArray, points: FloatArray, rolled: RolledImage | None = None
) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of the image as it was taken, and depths (N,) [m], of points (N, 3) of the map.

    Args:
        camera: its calibration.
        pose: (4, 4) map_from_camera.
        points: of the map [m].
        rolled: with a rolling shutter, where the image shows what the pose at the stamp would.
    """
    in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = in_camera[:, 2]
    rays = in_camera[:, :2] / np.maximum(depth, NEAR)[:, None]
    # Beyond the corners of the image a polynomial of the lens may fold back into it.
    corners = np.array([[x, y] for x in (0, 0.5, 1) for y in (0, 0.5, 1)]) * [camera.width - 1, camera.height - 1]
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    reach = 1.2 * np.abs((camera.undistort_points(corners) - centre) / focal).max(axis=0)
    beyond = (depth < NEAR) | (np.abs(rays) > reach).any(axis=1)
    pixels = np.clip(rays, -reach, reach) * focal + centre
    if rolled is not None:
        pixels = rolled.shown(pixels, np.maximum(depth, NEAR))
    pixels = camera.distort_points(pixels)
    pixels[beyond] = np.clip(rays[beyond], -10.0, 10.0) * focal + centre
    pixels[beyond & inside(camera, pixels)] = -1.0
    return pixels, depth


def inside(camera: Camera, pixels: FloatArray) -> NDArray[np.bool_]:
    """Which pixels (N, 2) lie in the image."""
    return np.asarray(((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1))
