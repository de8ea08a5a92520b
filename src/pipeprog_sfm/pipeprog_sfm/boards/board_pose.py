"""The pose of a board by the ellipses of one image: from three of them, and refined on all.

Poses are (4, 4) camera_from_board, m; `matrix` is the camera's.
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


@dataclass(frozen=True)
class BoardFit:
    """A pose, and what it explains: circles (K,), rows of the board's centres, and the ellipses (K,) that show them."""

    pose: FloatArray
    circles: NDArray[np.intp]
    members: NDArray[np.intp]

    def without(self, number: int) -> BoardFit:
        """The same without one of its circles."""
        return replace(self, circles=np.delete(self.circles, number), members=np.delete(self.members, number))


def three_point_poses(points: FloatArray, pixels: FloatArray, matrix: FloatArray) -> list[FloatArray]:
    """Poses that see points (3, 3), m, in pixels (3, 2), with the board's front to the camera."""
    _, turns, shifts = cv2.solveP3P(points[:, None], pixels[:, None], matrix, None, cv2.SOLVEPNP_AP3P)
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if np.isfinite(pose).all() and pose[:3, 2] @ pose[:3, 3] < 0 < pose[2, 3]:
            poses.append(pose)
    return poses


def misfit(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> FloatArray:
    """(K,) how far its ellipses are from what the pose predicts; up to 1 is agreement.

    Allowed are, for a centre, half a pixel or 3 % of the radius (lens, print), and for the outline one pixel or 5 %
    (exposure makes bright discs larger).
    """
    centres, shapes = project_circles(matrix, fit.pose, board.centres[fit.circles], board.circle_radius)
    radii = np.sqrt(np.sqrt(np.abs(np.linalg.det(shapes))))
    gaps = np.linalg.norm(centres - ellipses.centres[fit.members], axis=1) / np.maximum(0.03 * radii, 0.5)
    bends = np.linalg.norm(shapes - ellipses.shapes[fit.members], axis=(1, 2)) / (2 * radii)
    return np.maximum(gaps, bends / np.maximum(0.05 * radii, 1.0))


def refine_pose(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> BoardFit:
    """The same with the pose that fits the ellipses best (damped Gauss-Newton).

    Residuals are the centres, to 0.1 px, and the shapes, to 0.5 px: the size of a disc suffers from exposure.
    """
    pose, points = fit.pose, board.centres[fit.circles]
    centres, shapes = ellipses.centres[fit.members], ellipses.shapes[fit.members]
    size = 2 * np.sqrt(np.sqrt(np.abs(np.linalg.det(shapes))))[:, None]

    def residuals(candidate: FloatArray) -> FloatArray:
        centre, shape = project_circles(matrix, candidate, points, board.circle_radius)
        bend = (shape - shapes)[:, [0, 1, 0], [0, 1, 1]] / size
        return np.concatenate([(centre - centres) / 0.1, bend / 0.5], axis=1).ravel()

    steps = np.full(6, 1e-6)
    steps[3:] *= np.linalg.norm(pose[:3, 3])
    current = residuals(pose)
    damping = 1e-3
    for _ in range(20):
        jacobian = np.stack(
            [(residuals(_changed(pose, step)) - current) / step.sum() for step in np.diag(steps)], axis=1
        )
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ current
        change = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        candidate = _changed(pose, change)
        trial = residuals(candidate)
        if trial @ trial < current @ current and candidate[2, 3] > board.circle_radius:
            gain = 1.0 - (trial @ trial) / (current @ current)
            pose, current, damping = candidate, trial, damping / 10
            if gain < 1e-6:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return replace(fit, pose=pose)


def _changed(pose: FloatArray, change: FloatArray) -> FloatArray:
    """The pose turned by the rotation vector change[:3] about the board's origin and shifted by change[3:]."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += change[3:]
    return moved
