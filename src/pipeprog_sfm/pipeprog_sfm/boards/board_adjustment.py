"""A board's place adjusted on all of its images, and what it inherits from their errors and from the poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_covariance import (
    PRIOR_CENTRE,
    PRIOR_POSE,
    cauchy_weights,
    image_noise,
    variance_components,
)
from pipeprog_sfm.boards.placed_board import BoardView, CircleRows, PlacedBoard, circle_pixels, image_rows, project_rows
from pipeprog_sfm.boards.triangulation import cross_matrices
from pipeprog_sfm.config import BoardConfig


@dataclass(frozen=True)
class PlacementSensitivity:
    """What a placement inherits.

    Attributes:
        covariance: (7, 7) of turn, shift and logarithm of size about the board's middle, model units, from the images.
        derivatives: (7, 6) of these by each pose, turned and shifted from the left, by stamp.
    """

    covariance: FloatArray
    derivatives: Mapping[int, FloatArray]


def adjust_board(
    board: Board,
    views: Sequence[BoardView],
    start: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> PlacedBoard:
    """The placement adjusted on all views: seven parameters, robust weights, two variance components.

    The residuals of one image share what an error of its pose does to them, so that five circles in one image are
    not five independent witnesses: the covariance of an image is centre^2 I + pose^2 B B^T, where B holds the
    derivatives by the camera's place, in px per px at the board.
    """
    placement, centre, pose = start, PRIOR_CENTRE, PRIOR_POSE
    for _ in range(4):
        rows = image_rows(views, poses, circle_pixels(views, placement, poses, camera, config))
        for _ in range(6):
            residuals, jacobian = _similarity_rows(rows, placement, board, camera)
            noise = image_noise(jacobian[:, :, 3:6], rows.groups, centre, pose)
            white, white_jacobian = noise.whitened(residuals[..., None])[..., 0], noise.whitened(jacobian)
            root = np.sqrt(cauchy_weights(white))[:, None]
            flat, target = (white_jacobian * root[..., None]).reshape(-1, 7), (white * root).ravel()
            change = np.linalg.lstsq(flat, -target, rcond=None)[0]
            placement = _changed(placement, change, board)
            if np.abs(change).max() < 1e-10:
                break
        sigma = float(np.sqrt(np.linalg.pinv(flat.T @ flat)[6, 6]))
        components = centre, pose
        centre, pose = variance_components(noise, target, flat)
    return PlacedBoard(board, tuple(views), placement, sigma, *components)


def placement_sensitivity(
    place: PlacedBoard, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig
) -> PlacementSensitivity:
    """How a placement errs with its images and with the poses, at the minimum of its weighted squares."""
    rows = image_rows(place.views, poses, circle_pixels(place.views, place.model_from_board, poses, camera, config))
    residuals, jacobian = _similarity_rows(rows, place.model_from_board, place.board, camera)
    noise = image_noise(jacobian[:, :, 3:6], rows.groups, place.centre_sigma, place.pose_sigma)
    root = np.sqrt(cauchy_weights(noise.whitened(residuals[..., None])[..., 0]))[:, None, None]
    points = (place.board.centres @ place.model_from_board[:3, :3].T + place.model_from_board[:3, 3])[rows.circles]
    by_shift = project_rows(rows, points, camera)[1] @ rows.rotations.transpose(0, 2, 1)
    by_turn = by_shift @ -cross_matrices(np.einsum("nij,nj->ni", rows.rotations, points))
    white = noise.whitened(jacobian) * root
    by_pose = noise.whitened(np.concatenate([by_turn, by_shift], axis=-1)) * root
    flat = white.reshape(-1, 7)
    covariance = np.linalg.pinv(flat.T @ flat)
    products = np.zeros((len(place.views), 7, 6))
    np.add.at(products, rows.groups, white.transpose(0, 2, 1) @ by_pose)
    derivatives = -covariance @ products
    stamps = [view.stamp for view in place.views]
    return PlacementSensitivity(covariance, dict(zip(stamps, derivatives, strict=True)))


def _similarity_rows(
    rows: CircleRows, placement: FloatArray, board: Board, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Residuals (M, 2) and derivatives (M, 2, 7) by turn, shift and logarithm of size about the board's middle."""
    middle = placement[:3, :3] @ board.centres.mean(0) + placement[:3, 3]
    arms = (board.centres @ placement[:3, :3].T + placement[:3, 3] - middle)[rows.circles]
    pixels, by_point = project_rows(rows, middle + arms, camera)
    by_size = by_point @ arms[..., None]
    return pixels - rows.pixels, np.concatenate([by_point @ -cross_matrices(arms), by_point, by_size], axis=-1)


def _changed(placement: FloatArray, change: FloatArray, board: Board) -> FloatArray:
    """The placement changed by the seven parameters of `_similarity_rows`."""
    centre = board.centres.mean(0)
    middle = placement[:3, :3] @ centre + placement[:3, 3]
    changed = np.eye(4)
    changed[:3, :3] = np.exp(change[6]) * Rotation.from_rotvec(change[:3]).as_matrix() @ placement[:3, :3]
    changed[:3, 3] = middle + change[3:6] - changed[:3, :3] @ centre
    return changed
