# SPDX-License-Identifier: Apache-2.0
"""The pose of a board from the ellipses of one image: from three of them, then refined on all.

Poses are (4, 4) camera_from_board, m; `matrix` is the camera's (3, 3) K.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.conic import project_circles
from pipeprog_sfm.boards.ellipses import ImageEllipses

# Standard deviations of what an ellipse tells, px: its centre, and its outline, since a bright disc's image grows
# with the exposure.
CENTRE_SIGMA = 0.1
OUTLINE_SIGMA = 0.5
# Largest differences between an ellipse and the image of a circle: the larger of a length in px (five sigma of
# the centre, two of the outline) and a share of the radius (lens distortion, print).
MAX_CENTRE_GAP = (0.5, 0.03)
MAX_OUTLINE_GAP = (1.0, 0.05)

DIFFERENCE = 1e-6  # step of the numerical derivatives: rad, and of the board's distance
MAX_STEPS = 20
CONVERGED = 1e-6  # relative gain of the cost at which the steps end
MAX_DAMPING = 1e6  # at which no step gains any more


@dataclass(frozen=True)
class BoardFit:
    """A pose and the circles that it explains.

    Attributes:
        pose: (4, 4) camera_from_board, m.
        circles: (K,) rows of the board's centres.
        members: (K,) rows of the ellipses that show them.
    """

    pose: FloatArray
    circles: NDArray[np.intp]
    members: NDArray[np.intp]

    def without(self, number: int) -> BoardFit:
        """The same fit without the circle at one position of `circles`."""
        return replace(self, circles=np.delete(self.circles, number), members=np.delete(self.members, number))


def three_point_poses(points: FloatArray, pixels: FloatArray, matrix: FloatArray) -> list[FloatArray]:
    """Up to four poses that image points (3, 3), m, at pixels (3, 2), with the board's front to the camera."""
    _, turns, shifts = cv2.solveP3P(points[:, None], pixels[:, None], matrix, None, cv2.SOLVEPNP_AP3P)
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if np.isfinite(pose).all() and pose[:3, 2] @ pose[:3, 3] < 0 < pose[2, 3]:
            poses.append(pose)
    return poses


def misfit(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> FloatArray:
    """(K,) differences between the ellipses and the images of the circles, over the largest allowed: up to 1 agrees."""
    centres, shapes = project_circles(matrix, fit.pose, board.centres[fit.circles], board.circle_radius)
    radii = _radii(shapes)
    gaps = np.linalg.norm(centres - ellipses.centres[fit.members], axis=1)
    bends = np.linalg.norm(shapes - ellipses.shapes[fit.members], axis=(1, 2)) / (2 * radii)
    centre_limit, outline_limit = (
        np.maximum(share * radii, pixels) for pixels, share in (MAX_CENTRE_GAP, MAX_OUTLINE_GAP)
    )
    return np.maximum(gaps / centre_limit, bends / outline_limit)


def refine_pose(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> BoardFit:
    """The same with the pose that fits its ellipses best (Levenberg-Marquardt).

    scipy.optimize.least_squares finds the same minimum (its cost to 1e-7) in 1.5 in place of 0.9 ms a board; every
    keyframe that shows one has several to try.
    """
    pose, points = fit.pose, board.centres[fit.circles]
    centres, shapes = ellipses.centres[fit.members], ellipses.shapes[fit.members]
    size = 2 * _radii(shapes)[:, None]

    def residuals(candidate: FloatArray) -> FloatArray:
        centre, shape = project_circles(matrix, candidate, points, board.circle_radius)
        bend = (shape - shapes)[:, [0, 1, 0], [0, 1, 1]] / size
        return np.concatenate([(centre - centres) / CENTRE_SIGMA, bend / OUTLINE_SIGMA], axis=1).ravel()

    steps = np.full(6, DIFFERENCE)
    steps[3:] *= np.linalg.norm(pose[:3, 3])
    current = residuals(pose)
    damping = 1e-3
    for _ in range(MAX_STEPS):
        differences = [residuals(_changed(pose, step)) - current for step in np.diag(steps)]
        jacobian = np.stack([each / step for each, step in zip(differences, steps, strict=True)], axis=1)
        normal = jacobian.T @ jacobian
        change = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -jacobian.T @ current)
        candidate = _changed(pose, change)
        trial = residuals(candidate)
        if trial @ trial < current @ current and candidate[2, 3] > board.circle_radius:
            gain = 1.0 - (trial @ trial) / (current @ current)
            pose, current, damping = candidate, trial, damping / 10
            if gain < CONVERGED:
                break
        else:
            damping *= 10
            if damping > MAX_DAMPING:
                break
    return replace(fit, pose=pose)


def _radii(shapes: FloatArray) -> FloatArray:
    """(K,) geometric means of the semi-axes of (K, 2, 2) shape matrices, px."""
    return np.sqrt(np.sqrt(np.abs(np.linalg.det(shapes))))


def _changed(pose: FloatArray, change: FloatArray) -> FloatArray:
    """The pose turned by the rotation vector change[:3] about the board's origin and shifted by change[3:]."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += change[3:]
    return moved
