# SPDX-License-Identifier: Apache-2.0
"""A board's place in the model, adjusted on all of its images, and its errors with those of images and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_covariance import (
    PRIOR_CENTRE,
    PRIOR_POSE,
    cauchy_weights,
    image_noise,
    variance_components,
)
from pipeprog_sfm.boards.placed_board import BoardView, CircleRows, PlacedBoard, PosedCamera
from pipeprog_sfm.boards.rays import cross_matrices

VARIANCE_ROUNDS = 4  # each halves the distance of the variance components from their limit, or better
MAX_STEPS = 6  # Gauss-Newton steps of a round, from a start that triangulation gives to 1 % of the size
CONVERGED = 1e-10  # largest change of a parameter (rad, model units, log of size) at which the steps end


@dataclass(frozen=True)
class PlacementSensitivity:
    """How errors of images and poses propagate to a placed board.

    The seven parameters are the turn, the shift and the logarithm of the size about the mean of the board's circles,
    in radians and model units.

    Attributes:
        covariance: (7, 7) of the parameters, from the images.
        derivatives: (7, 6) of the parameters by each pose, turned and shifted from the left, by stamp.
    """

    covariance: FloatArray
    derivatives: Mapping[int, FloatArray]


def adjust_board(
    board: Board, views: Sequence[BoardView], model_from_board: FloatArray, posed: PosedCamera
) -> PlacedBoard:
    """The board placed by a least-squares fit to all views: seven parameters, robust weights, two variance components.

    The circles of one image share the error of its pose, so five circles in one image are not five independent
    measurements: the covariance of an image is centre^2 I + pose^2 B B^T, where B holds the derivatives by the
    camera's position, scaled to px at the board.

    Args:
        board: the board.
        views: images of it, two or more.
        model_from_board: (4, 4) similarity to start from.
        posed: camera and poses.
    """
    placement, centre, pose = model_from_board, PRIOR_CENTRE, PRIOR_POSE
    for _ in range(VARIANCE_ROUNDS):
        rows = posed.rows(views, placement)
        for _ in range(MAX_STEPS):
            residuals, jacobian = _similarity_rows(rows, placement, board, posed)
            noise = image_noise(jacobian[:, :, 3:6], rows.groups, centre, pose)
            white, white_jacobian = noise.whitened(residuals[..., None])[..., 0], noise.whitened(jacobian)
            root = np.sqrt(cauchy_weights(white))[:, None]
            flat, weighted = (white_jacobian * root[..., None]).reshape(-1, 7), (white * root).ravel()
            change = np.linalg.lstsq(flat, -weighted, rcond=None)[0]
            placement = _changed(placement, change, board)
            if np.abs(change).max() < CONVERGED:
                break
        sigma = float(np.sqrt(np.linalg.pinv(flat.T @ flat)[6, 6]))
        components = centre, pose
        centre, pose = variance_components(noise, weighted, flat)
    return PlacedBoard(board, tuple(views), placement, sigma, *components)


def placement_sensitivity(place: PlacedBoard, posed: PosedCamera) -> PlacementSensitivity:
    """Covariance of a placed board by its images and derivatives by the poses, at the minimum of its cost."""
    rows = posed.rows(place.views, place.model_from_board)
    residuals, jacobian = _similarity_rows(rows, place.model_from_board, place.board, posed)
    noise = image_noise(jacobian[:, :, 3:6], rows.groups, place.centre_sigma, place.pose_sigma)
    root = np.sqrt(cauchy_weights(noise.whitened(residuals[..., None])[..., 0]))[:, None, None]
    points = place.circles_in_model[rows.circles]
    by_shift = posed.project(rows, points)[1] @ rows.rotations.transpose(0, 2, 1)
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
    rows: CircleRows, placement: FloatArray, board: Board, posed: PosedCamera
) -> tuple[FloatArray, FloatArray]:
    """Residuals (M, 2) px and their derivatives (M, 2, 7) by the seven parameters of `PlacementSensitivity`."""
    middle = placement[:3, :3] @ board.centres.mean(0) + placement[:3, 3]
    arms = (board.centres @ placement[:3, :3].T + placement[:3, 3] - middle)[rows.circles]
    pixels, by_point = posed.project(rows, middle + arms)
    by_size = by_point @ arms[..., None]
    return pixels - rows.pixels, np.concatenate([by_point @ -cross_matrices(arms), by_point, by_size], axis=-1)


def _changed(placement: FloatArray, change: FloatArray, board: Board) -> FloatArray:
    """The (4, 4) placement changed by the seven parameters of `PlacementSensitivity`."""
    centre = board.centres.mean(0)
    middle = placement[:3, :3] @ centre + placement[:3, 3]
    changed = np.eye(4)
    changed[:3, :3] = np.exp(change[6]) * Rotation.from_rotvec(change[:3]).as_matrix() @ placement[:3, :3]
    changed[:3, 3] = middle + change[3:6] - changed[:3, :3] @ centre
    return changed
