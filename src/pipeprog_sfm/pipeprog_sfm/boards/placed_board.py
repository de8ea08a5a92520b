"""A board at a place of the model, and its images as rows of equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board, BoardObservation
from pipeprog_sfm.boards.conic import circle_centre_images
from pipeprog_sfm.config import BoardConfig


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
        model_from_board: (4, 4) similarity, metres on the board to model units.
        sigma: relative standard deviation of `scale`, from the scatter of the images.
        centre_sigma: standard deviation of a circle's centre, px.
        pose_sigma: what the poses add to that from image to image, px at the board.
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

    def upside_down(self) -> PlacedBoard:
        """The same, turned by 180 degrees in the board's plane about the middle of its circles."""
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        turn[:3, 3] = 2 * self.board.centres.mean(0)
        return replace(self, model_from_board=self.model_from_board @ turn)


@dataclass(frozen=True)
class CircleRows:
    """One row for each circle in each image: pixels, what made them, and the image's camera."""

    pixels: FloatArray  # (M, 2)
    circles: NDArray[np.intp]  # (M,)
    groups: NDArray[np.intp]  # (M,) index of the image
    rotations: FloatArray  # (M, 3, 3)
    translations: FloatArray  # (M, 3)

    def take(self, chosen: NDArray[np.bool_]) -> CircleRows:
        """The rows of a mask (M,)."""
        return CircleRows(*(value[chosen] for value in vars(self).values()))


def image_rows(views: Sequence[BoardView], poses: Mapping[int, FloatArray], pixels: Sequence[FloatArray]) -> CircleRows:
    """Rows of all views; poses (4, 4) camera_from_model by stamp; pixels (K, 2) of the circles of each view."""
    groups = np.concatenate([np.full(len(view.seen.indices), index) for index, view in enumerate(views)])
    stack = np.array([poses[view.stamp] for view in views])[groups]
    circles = np.concatenate([view.seen.indices for view in views])
    return CircleRows(np.concatenate(pixels), circles, groups, stack[:, :3, :3], stack[:, :3, 3])


def circle_pixels(
    views: Sequence[BoardView],
    placement: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> list[FloatArray]:
    """Images of the circles' centres, freed from eccentricity with the plane of the placement."""
    if not config.eccentricity:
        return [view.seen.ellipse_centres for view in views]
    normal = placement[:3, 2] / np.linalg.norm(placement[:3, 2])
    return [circle_centre_images(view.seen.conics, camera.matrix, poses[view.stamp][:3, :3] @ normal) for view in views]


def project_rows(rows: CircleRows, points: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Pixels (M, 2) of model points (M, 3), and derivatives (M, 2, 3) by the points."""
    x, y, z = (np.einsum("nij,nj->ni", rows.rotations, points) + rows.translations).T
    z = np.where(z > 1e-9, z, 1e-9)
    zero = np.zeros_like(z)
    by_camera = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * x / z**2], -1),
            np.stack([zero, camera.fy / z, -camera.fy * y / z**2], -1),
        ],
        axis=1,
    )
    return np.c_[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], by_camera @ rows.rotations
