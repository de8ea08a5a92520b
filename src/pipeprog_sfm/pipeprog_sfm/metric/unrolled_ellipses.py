# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter of boards and scale bars: ellipses where a camera with all rows at the stamp would have them.

The shift of an edge point depends on the depth of the disc. That of the nearest points of the model places the boards;
their planes then give the depth of each edge point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.boards.ellipses import PROFILES, ImageEllipses, fit_ellipses, rim_points
from pipeprog_sfm.boards.placed_board import PlacedBoard

_DEPTH_ROUNDS = (
    2  # the depth at the measured pixel, then at the unrolled one: 3 px aside, 0.3 % on a plane at 45 degrees
)


@dataclass(frozen=True)
class RollingViews:
    """What unrolls the pixels of a model's views.

    Attributes:
        motions: by stamp [ns], lengths in model units; views of unknown motion are missing.
        points_seen: gives the (K, 3) points of the model that the view of a stamp sees.
    """

    motions: Mapping[int, RowMotion]
    points_seen: Callable[[int], FloatArray]


def unrolled_ellipses(
    ellipses: Mapping[int, ImageEllipses],
    cameras: Mapping[int, Camera],
    poses: Mapping[int, FloatArray],
    rolling: RollingViews,
    place: Callable[[Mapping[int, ImageEllipses]], tuple[Mapping[int, ImageEllipses], Sequence[PlacedBoard]]],
) -> dict[int, ImageEllipses]:
    """All ellipses, those of views of known motion as the middle row's camera has them.

    Those that do not change once the boards are placed are returned as the same objects.

    Args:
        ellipses: measured, by stamp [ns].
        cameras: of the images, by stamp.
        poses: (4, 4) camera_from_model, by stamp.
        rolling: motions of the views.
        place: finds boards and discs by ellipses; returns these as the views of the boards name them.
    """
    planes: dict[int, FloatArray] = {}
    for stamp, found in ellipses.items():
        if stamp in rolling.motions and stamp in poses:
            inside = rolling.points_seen(stamp) @ poses[stamp][:3, :3].T + poses[stamp][:3, 3]
            if len(inside):
                planes[stamp] = _facing_planes(found, inside, cameras[stamp])

    def shifted(stamps: Iterable[int]) -> dict[int, ImageEllipses]:
        return {
            stamp: _unrolled(ellipses[stamp], planes[stamp], rolling.motions[stamp], cameras[stamp]) for stamp in stamps
        }

    first = dict(ellipses) | shifted(planes)
    named, boards = place(first)
    changed = set()
    for board in boards:
        for view in board.views:
            if view.stamp not in planes:
                continue
            members = (named[view.stamp].centres[:, None] == view.seen.ellipse_centres[None]).all(-1).any(1)
            planes[view.stamp][members] = _plane(board, poses[view.stamp])
            changed.add(view.stamp)
    return first | shifted(changed)


def _facing_planes(ellipses: ImageEllipses, points: FloatArray, camera: Camera) -> FloatArray:
    """(E, 4) planes, normal and distance, across the optical axis at the depth of the point nearest in the image."""
    points = points[points[:, 2] > 0]
    pixels = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    depths = points[cKDTree(pixels).query(ellipses.centres)[1], 2]
    return np.c_[np.zeros((len(depths), 2)), np.ones(len(depths)), depths]


def _plane(board: PlacedBoard, camera_from_model: FloatArray) -> FloatArray:
    """(4,) normal and distance of a board's plane in the camera's frame, model units."""
    normal = camera_from_model[:3, :3] @ board.model_from_board[:3, 2]
    normal /= np.linalg.norm(normal)
    place = camera_from_model[:3, :3] @ board.circles_in_model.mean(axis=0) + camera_from_model[:3, 3]
    return np.append(normal, normal @ place)


def _unrolled(ellipses: ImageEllipses, planes: FloatArray, motion: RowMotion, camera: Camera) -> ImageEllipses:
    """Points on the rims, unrolled by the depth of their planes (E, 4), and fitted again."""
    if not len(ellipses):
        return ellipses
    measured = rim_points(ellipses.centres, ellipses.shapes)[0].reshape(-1, 2)
    each = np.repeat(planes, PROFILES, axis=0)
    pixels: FloatArray = measured
    for _ in range(_DEPTH_ROUNDS):
        rays = np.c_[(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))]
        pixels = motion.unrolled_pixels(measured, each[:, 3] / (rays * each[:, :3]).sum(axis=1), camera)
    rims = pixels.reshape(len(ellipses), PROFILES, 2)
    centres, shapes, _, good = fit_ellipses(rims, np.ones(rims.shape[:2]))
    return ImageEllipses(
        np.where(good[:, None], centres, ellipses.centres),
        np.where(good[:, None, None], shapes, ellipses.shapes),
        ellipses.rms,
    )
