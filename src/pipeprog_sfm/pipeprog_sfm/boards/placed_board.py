# SPDX-License-Identifier: Apache-2.0
"""A board placed in the model, the images that show it, and their circles as rows of equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board, BoardObservation
from pipeprog_sfm.boards.conic import circle_centre_images


@dataclass(frozen=True)
class BoardView:
    """An image of a board: its stamp [ns], and which circles it shows where."""

    stamp: int
    seen: BoardObservation


@dataclass(frozen=True)
class PlacedBoard:
    """A board at one place of the model.

    Attributes:
        board: the board.
        views: images of it.
        model_from_board: (4, 4) similarity from metres on the board to model units.
        sigma: relative standard deviation of `scale`, from the scatter of the images.
        centre_sigma: standard deviation of a circle's centre, px.
        pose_sigma: standard deviation that pose errors add, the same for all circles of an image, px at the board.
    """

    board: Board
    views: tuple[BoardView, ...]
    model_from_board: FloatArray
    sigma: float
    centre_sigma: float
    pose_sigma: float

    @property
    def scale(self) -> float:
        """Metres per model unit."""
        return 1.0 / float(np.cbrt(np.linalg.det(self.model_from_board[:3, :3])))

    @property
    def circles_in_model(self) -> FloatArray:
        """(N, 3) centres of the circles, model units."""
        return self.board.centres @ self.model_from_board[:3, :3].T + self.model_from_board[:3, 3]

    def upside_down(self) -> PlacedBoard:
        """The same board, turned by 180 degrees in its plane about the mean of its circles."""
        return replace(self, model_from_board=self.model_from_board @ self.board.half_turn)


@dataclass(frozen=True)
class CircleRows:
    """One row for each circle in each image: its pixel, its number, and the pose of the image."""

    pixels: FloatArray  # (M, 2)
    circles: NDArray[np.intp]  # (M,) row of Board.centres
    groups: NDArray[np.intp]  # (M,) index of the image
    rotations: FloatArray  # (M, 3, 3) camera_from_model
    translations: FloatArray  # (M, 3)

    def take(self, chosen: NDArray[np.bool_]) -> CircleRows:
        """The rows of a mask (M,)."""
        return CircleRows(*(value[chosen] for value in vars(self).values()))


@dataclass(frozen=True)
class PosedCamera:
    """A calibrated camera and where it was at each image.

    Attributes:
        camera: calibration.
        poses: (4, 4) camera_from_model by stamp [ns], in order of time.
        eccentricity: whether circle centres are corrected for eccentricity.
    """

    camera: Camera
    poses: Mapping[int, FloatArray]
    eccentricity: bool = True

    def centre(self, stamp: int) -> FloatArray:
        """(3,) projection centre of an image in the model."""
        pose = self.poses[stamp]
        return np.asarray(-pose[:3, :3].T @ pose[:3, 3])

    def rows(self, views: Sequence[BoardView], model_from_board: FloatArray) -> CircleRows:
        """Circles of all views, their centres corrected for eccentricity with the plane of (4, 4) model_from_board."""
        if not self.eccentricity:
            return self.rows_at(views, [view.seen.ellipse_centres for view in views])
        normal = model_from_board[:3, 2] / np.linalg.norm(model_from_board[:3, 2])
        pixels = [
            circle_centre_images(view.seen.conics, self.camera.matrix, self.poses[view.stamp][:3, :3] @ normal)
            for view in views
        ]
        return self.rows_at(views, pixels)

    def rows_at(self, views: Sequence[BoardView], pixels: Sequence[FloatArray]) -> CircleRows:
        """Circles of all views with pixels (K, 2) of the circles of each view."""
        groups = np.concatenate([np.full(len(view.seen.indices), index) for index, view in enumerate(views)])
        stack = np.array([self.poses[view.stamp] for view in views])[groups]
        circles = np.concatenate([view.seen.indices for view in views])
        return CircleRows(np.concatenate(pixels), circles, groups, stack[:, :3, :3], stack[:, :3, 3])

    def pixels(self, rows: CircleRows, points: FloatArray) -> FloatArray:
        """(M, 2) pixels of model points (M, 3) in the images of the rows."""
        return self._shown(*_inside(rows, points))

    def project(self, rows: CircleRows, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (M, 2) of model points (M, 3) in the images of the rows, and derivatives (M, 2, 3) by the points."""
        camera = self.camera
        x, y, z = _inside(rows, points)
        zero = np.zeros_like(z)
        by_camera = np.stack(
            [
                np.stack([camera.fx / z, zero, -camera.fx * x / z**2], -1),
                np.stack([zero, camera.fy / z, -camera.fy * y / z**2], -1),
            ],
            axis=1,
        )
        return self._shown(x, y, z), by_camera @ rows.rotations

    def _shown(self, x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        """(M, 2) pixels of points in the cameras' frames."""
        camera = self.camera
        return np.c_[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]


def _inside(rows: CircleRows, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coordinates (M,) of model points (M, 3) in the frames of the rows' cameras; the depth is positive."""
    x, y, z = (np.einsum("nij,nj->ni", rows.rotations, points) + rows.translations).T
    return x, y, np.where(z > 1e-9, z, 1e-9)
