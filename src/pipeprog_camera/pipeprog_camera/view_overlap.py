# SPDX-License-Identifier: Apache-2.0
"""How much of what one view shows others show as well, from the same side and distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera

SAMPLE = 200  # points of a view from which its overlap with others is estimated, to 0.04
SAME_SIDE = np.radians(8.0)  # between rays to a point; beyond (baseline 0.14 of the depth) a view adds information
SAME_SCALE = 1.5  # ratio of depths; a view that is nearer by more shows more detail
# Share of what a view of a rolling shutter shows that those before and after it must show as well where it came for the
# motion alone: as much as those of a global shutter overlap, where none is chosen for that (frames.overlap_min).
FOR_THE_MOTION = 0.85


def sample(points: FloatArray) -> FloatArray:
    """Some of (K, 3) points, from all over the image."""
    return points[:: max(len(points) // SAMPLE, 1)]


def view_overlap(
    points: FloatArray, camera_from_model: FloatArray, others: Sequence[tuple[FloatArray, Camera]]
) -> FloatArray:
    """(V,) share of the (K, 3) points of one view that each of the others sees from the same side and distance.

    others: (4, 4) camera_from_model and calibration of each.
    """
    if not others:
        return np.zeros(0)
    poses = np.stack([camera_from_model, *(pose for pose, _ in others)])
    depth = points @ poses[:, 2, :3].T + poses[:, 2, 3]
    rays = points - -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    seen = in_image(points, others)
    seen &= (np.einsum("vki,ki->vk", rays, rays[0]) > np.cos(SAME_SIDE))[1:]
    seen &= depth.T[1:] < SAME_SCALE * depth.T[0]
    return np.asarray(seen.mean(axis=1), np.float64)


def is_shown_beside(points: FloatArray, before: tuple[FloatArray, Camera], after: tuple[FloatArray, Camera]) -> bool:
    """Whether the views before and after one, of a rolling shutter, both show enough of the (K, 3) points of that one.

    Keyframes of a rolling shutter are denser in time than their overlap asks for: poses between them tell how the
    camera moves. Measured in all of them, a scene takes longer, and is the same.
    """
    return bool(len(points)) and bool(in_image(points, [before, after]).all(axis=0).mean() >= FOR_THE_MOTION)


def in_image(points: FloatArray, views: Sequence[tuple[FloatArray, Camera]]) -> NDArray[np.bool_]:
    """(V, K) whether views, each a (4, 4) camera_from_model and a calibration, show the (K, 3) points."""
    if not views:
        return np.zeros((0, len(points)), bool)
    poses = np.stack([pose for pose, _ in views])
    inside = np.einsum("vij,kj->vki", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    cameras = [(each.fx, each.fy, each.cx, each.cy, each.width, each.height) for _, each in views]
    fx, fy, cx, cy, width, height = np.array(cameras, float).T[..., None]
    depth = inside[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = inside[..., 0] / depth * fx + cx
        v = inside[..., 1] / depth * fy + cy
    return np.asarray((depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
