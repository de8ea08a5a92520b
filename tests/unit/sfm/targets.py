# SPDX-License-Identifier: Apache-2.0
"""A camera, boards and their exact or rendered images for the tests of boards and scale."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.conic import project_circles
from pipeprog_sfm.boards.ellipses import ImageEllipses

CAMERA = Camera(640, 400, 500.0, 500.0, 319.5, 199.5)
PLANE = np.array([[-240, 150], [240, 150], [0, 0], [-240, -150], [240, -150]]) / 1000
BOARD = Board("A", 0.04, np.c_[PLANE, np.zeros(5)])
LOPSIDED = Board(
    "B", 0.03, np.array([[-180, 130, 0], [180, 130, 0], [50, 30, 0], [-180, -130, 0], [180, -130, 0]]) / 1000
)


def camera_from_board(place: tuple[float, float, float], target: tuple[float, float, float], roll: float = 0.0):
    """(4, 4) pose of a camera at `place` in the board's frame that looks at `target` with y down the board."""
    centre, forward = np.array(place, float), np.subtract(target, place).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, roll]).as_matrix() @ np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def exact_ellipses(boards, poses, camera=CAMERA, noise=0.0, rng=None) -> ImageEllipses:
    """The images of boards, one pose each, without rendering; only circles that are wholly in the image."""
    parts = [
        project_circles(camera.matrix, pose, b.centres, b.circle_radius) for b, pose in zip(boards, poses, strict=True)
    ]
    centres, shapes = (np.concatenate(values) for values in zip(*parts, strict=True))
    reach = np.sqrt(shapes[:, [0, 1], [0, 1]])
    inside = ((centres > reach) & (centres < np.array([camera.width, camera.height]) - reach)).all(1)
    if rng is not None:
        centres = centres + rng.normal(0.0, noise, centres.shape)
    return ImageEllipses(centres[inside], shapes[inside], np.full(inside.sum(), max(noise, 0.01) * np.sqrt(32)))


def render(board: Board, pose: np.ndarray, camera: Camera = CAMERA, seed: int = 0) -> np.ndarray:
    """(H, W) uint8 image of the board on a mottled wall, anti-aliased, blurred and noisy."""
    rng = np.random.default_rng(seed)
    sub = 2
    steps = (np.arange(sub) + 0.5) / sub - 0.5
    columns = (np.arange(camera.width)[:, None] + steps).ravel()
    rows = (np.arange(camera.height)[:, None] + steps).ravel()
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    rays = np.c_[camera.undistort_points(pixels), np.ones(len(pixels))] @ np.linalg.inv(camera.matrix).T
    rays = rays @ pose[:3, :3]
    origin = -pose[:3, :3].T @ pose[:3, 3]
    place = origin[:2] - rays[:, :2] * (origin[2] / rays[:, 2:])
    low, high = board.centres.min(0)[:2] - 0.07, board.centres.max(0)[:2] + 0.07
    plate = ((place > low) & (place < high)).all(1)
    disc = np.zeros(len(place), bool)
    for centre in board.centres[:, :2]:
        disc |= ((place - centre) ** 2).sum(1) < board.circle_radius**2
    wall = cv2.resize(rng.uniform(80, 200, (40, 64)).astype(np.float32), (camera.width * sub, camera.height * sub))
    image = np.where(disc, 190.0, np.where(plate, 35.0, wall.ravel())).reshape(camera.height * sub, camera.width * sub)
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2.0, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


AT_ORIGIN = (BOARD, np.eye(4))


class Walk:
    """A camera that walks past boards in a world of metres, and a model that is that world up to a similarity."""

    def __init__(self, seed, views=8, noise=0.0, pose_noise=0.0, boards=(AT_ORIGIN,), span=1.6, follow=0.6, roll=0.0):
        rng = np.random.default_rng(seed)
        self.factor = rng.uniform(0.2, 5.0)  # model units per metre
        self.model_from_board = np.eye(4)
        self.model_from_board[:3, :3] = self.factor * Rotation.random(random_state=seed).as_matrix()
        self.model_from_board[:3, 3] = rng.normal(0, 3, 3)
        self.poses, self.ellipses = {}, {}
        for stamp in range(views):
            x = span * (stamp / max(views - 1, 1) - 0.5)
            pose = camera_from_board((x, rng.normal(0, 0.1), 1.6 + rng.normal(0, 0.1)), (follow * x, 0, 0), roll)
            seen = [pose @ place for _, place in boards]
            self.ellipses[stamp] = exact_ellipses([board for board, _ in boards], seen, noise=noise, rng=rng)
            moved = pose.copy()
            moved[:3, 3] += rng.normal(0, pose_noise, 3)
            self.poses[stamp] = self.in_model(moved)

    def in_model(self, camera_from_board_pose):
        pose = np.eye(4)
        pose[:3, :3] = camera_from_board_pose[:3, :3] @ self.model_from_board[:3, :3].T / self.factor
        centre = -camera_from_board_pose[:3, :3].T @ camera_from_board_pose[:3, 3]
        pose[:3, 3] = -pose[:3, :3] @ (self.model_from_board[:3, :3] @ centre + self.model_from_board[:3, 3])
        return pose
