# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the contour tests: a ray-cast pipe before a textured wall with a lamp's shadow beside it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, WALL, barrel_depth

SAMPLES = 2
# Seen from the camera, 30 ms from the first row to the last: 6 px sideways at the pipe, 2 px of turn, 1 px of roll.
MOTION = RowMotion(0.03, 270, np.array([-0.75, 0.1, 0.05]), np.array([0.1, 0.2, 0.15]))


def _look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """camera_from_map (4, 4) of a camera at `centre` that looks at `target` with the map's z upwards."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def _rolled_poses(pose: np.ndarray, rows: np.ndarray, motion: RowMotion | None) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) map_from_camera and centres (N, 3) of a camera when it exposes rows (N,)."""
    if motion is None:
        return np.tile(pose[:3, :3].T, (len(rows), 1, 1)), np.tile(-pose[:3, :3].T @ pose[:3, 3], (len(rows), 1))
    times = motion.row_times(rows)[:, None]
    turned = Rotation.from_rotvec(motion.angular * times).as_matrix() @ pose[:3, :3]
    shifted = Rotation.from_rotvec(motion.angular * times).apply(pose[:3, 3]) + motion.linear * times
    return turned.transpose(0, 2, 1), -np.einsum("nji,nj->ni", turned, shifted)


def _render(
    cylinder: Cylinder | None,
    pose: np.ndarray,
    camera: Camera,
    shadow_at: float,
    seed: int,
    motion: RowMotion | None = None,
) -> np.ndarray:
    """Grey image (H, W) uint8; the wall is the plane y = WALL, the shadow's edge on it lies at x = shadow_at."""
    columns, rows = ((np.arange(size * SAMPLES) + 0.5) / SAMPLES - 0.5 for size in (camera.width, camera.height))
    u, v = np.meshgrid(columns, rows)
    rotations, centres = _rolled_poses(pose, np.repeat(np.arange(camera.height), SAMPLES), motion)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = np.einsum("vij,vuj->vui", rotations, rays)
    centre = centres[:, None]
    on_wall = centre + rays * ((WALL - centre[..., 1]) / rays[..., 1])[..., None]
    texture = np.random.default_rng(7)
    light = np.full(u.shape, 0.30)
    for frequency, phase in zip(texture.normal(0, 60, (8, 2)), texture.uniform(0, 6.28, 8), strict=True):
        light += 0.012 * np.cos(on_wall[..., 0] * frequency[0] + on_wall[..., 2] * frequency[1] + phase)
    in_shadow = (on_wall[..., 0] > shadow_at) & (on_wall[..., 0] < shadow_at + 0.08)
    light = np.where(in_shadow, 0.25 * light, light)
    if cylinder is not None:
        depth = barrel_depth(cylinder, centre, rays)
        hit = np.isfinite(depth)
        offset = centre - cylinder.start + np.where(hit, depth, 0.0)[..., None] * rays
        normal = (offset - (offset @ cylinder.axis)[..., None] * cylinder.axis) / cylinder.radius
        lamp = np.array([-0.5, -0.8, 0.3]) / np.linalg.norm([0.5, 0.8, 0.3])
        light = np.where(hit, 0.08 + 0.12 * np.clip(normal @ lamp, 0.0, None), light)
    light = light.reshape(camera.height, SAMPLES, camera.width, SAMPLES).mean(axis=(1, 3))
    light = cv2.GaussianBlur(light, (0, 0), 0.5)
    level = np.where(light < 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-6) ** (1 / 2.4) - 0.055)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, level.shape)
    return np.clip(np.round(255 * level + noise), 0, 255).astype(np.uint8)


def _walk(cylinder: Cylinder | None, shadow_at: float, count: int = 8, motion: RowMotion | None = None) -> list[View]:
    """Views from a walk of 0.9 m past the pipe at 1.2 m from it."""
    camera = Camera(480, 270, 345.0, 345.0, 239.5, 134.5)
    rolled = None if motion is None else RolledImage(motion, camera)
    views = []
    for index, x in enumerate(np.linspace(-0.45, 0.45, count)):
        centre = np.array([x, -1.2, 0.08 * np.sin(3.0 * index)])
        pose = _look_at(centre, np.array([0.3 * x, 0.0, 0.0]))
        image = _render(cylinder, pose, camera, shadow_at, index, motion)
        views.append(View(index, image, camera, pose, rolled=rolled))
    return views


@pytest.fixture(scope="session")
def pipe_views() -> list[View]:
    """A walk past the pipe; the shadow's edge on the wall lies 5 mm beside the contour and is the stronger one."""
    return _walk(PIPE, shadow_at=0.055)


@pytest.fixture(scope="session")
def empty_views() -> list[View]:
    """The same walk without the pipe."""
    return _walk(None, shadow_at=0.055, count=4)


@pytest.fixture(scope="session")
def rolled_views() -> list[View]:
    """The walk past the pipe with a rolling shutter."""
    return _walk(PIPE, shadow_at=0.055, motion=MOTION)
