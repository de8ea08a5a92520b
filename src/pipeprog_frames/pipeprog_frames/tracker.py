"""Predicts overlap and parallax with the last keyframe on a reduced image, in milliseconds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_frames.decoding import GrayImage

PointArray = NDArray[np.float32]
FloatArray = NDArray[np.float64]

CELLS = 16  # along the image's longer side, one corner each: four times what a hull and a median need
BLOCK = 3  # px, of the window that a corner is judged by
LEAST_QUALITY = 0.01  # of the image's best corner
LEAST_EIGENVALUE = 2e-5  # more than what two grey levels of noise make of a blank image at a quarter of its size
MIN_CORNERS = 30  # below this a hull and a median say nothing
MIN_TRACKED = 10  # an affine map takes three: the rest are witnesses
AGREEING_MIN = 0.4  # corners that slid agree by chance on some map: a minority is no evidence
RELIEF_MAX = 0.03  # share of the width by which near and far points may part from one affine map between keyframes
LK_WINDOW = (9, 9)  # at the coarsest level already half of the image's height: a larger one would look past its edge
LK_LEVELS = 4  # reaches 9/2 * 2^4 = 72 px, a quarter of the width: a turn of 16 degrees between frames
LK_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)  # finer than what a share of area asks for
KABSCH_ROUNDS = 3  # more move the median by less than a pixel of the full image, a fiftieth of what makes a keyframe


def sharpness(gray: GrayImage) -> float:
    """Variance of the Laplacian, whose mean is zero; comparable among neighbouring frames only."""
    return cv2.norm(cv2.Laplacian(gray, cv2.CV_16S)) ** 2 / gray.size


def corners(gray: GrayImage) -> PointArray:
    """(N, 2) corners to track: the best of each cell (Shi and Tomasi, CVPR 1994), so they are spread over the image."""
    quality = cv2.cornerMinEigenVal(gray, BLOCK)
    height, width = gray.shape
    size = max(height, width) // CELLS
    rows, columns = height // size, width // size
    cells = quality[: rows * size, : columns * size].reshape(rows, size, columns, size).swapaxes(1, 2)
    cells = cells.reshape(rows * columns, size * size)
    best = cells.argmax(axis=1)
    row, column = np.divmod(np.arange(rows * columns), columns)
    found = np.stack([column * size + best % size, row * size + best // size], axis=1).astype(np.float32)
    strength = cells[np.arange(rows * columns), best]
    return found[strength > max(LEAST_QUALITY * float(strength.max()), LEAST_EIGENVALUE)]


def _shared_area(affine: NDArray[np.float64], width: int, height: int) -> float:
    """Share of the image that the keyframe's image covers after the (2, 3) map `affine`."""
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = (frame @ affine[:, :2].T + affine[:, 2]).astype(np.float32)
    return float(cv2.intersectConvexConvex(frame, moved)[0]) / (width * height)


@dataclass(frozen=True)
class Track:
    """How a frame relates to the keyframe: overlap in [0, 1]; parallax in px of the full image; corners still held."""

    overlap: float
    parallax: float
    tracked: int


@dataclass(frozen=True)
class _State:
    """The last image, and the (N, 2) corners still held: their (N, 3) rays and places in the keyframe, places in it."""

    image: GrayImage
    rays: FloatArray
    reference: PointArray
    current: PointArray

    def kept(self, held: NDArray[np.bool_]) -> _State:
        return _State(self.image, self.rays[held], self.reference[held], self.current[held])


class Tracker:
    """Follows the corners of the last keyframe from frame to frame (pyramidal Lucas-Kanade)."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        none = np.empty((0, 2), np.float32)
        self._state = self._undo = _State(np.empty((0, 0), np.uint8), np.empty((0, 3)), none, none)

    def start(self, gray: GrayImage) -> int:
        """Makes (h, w) `gray` the keyframe; returns its number of corners."""
        found = corners(gray)
        self._state = _State(gray, self._unit_rays(found, gray.shape[1]), found, found)
        return len(found)

    def track(self, gray: GrayImage) -> Track:
        """Follows the corners into (h, w) `gray`; start() comes before."""
        self._undo = before = self._state
        height, width = gray.shape
        if len(before.current) < MIN_TRACKED:
            return self._lost(gray)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            before.image, gray, before.current, None, winSize=LK_WINDOW, maxLevel=LK_LEVELS, criteria=LK_CRITERIA
        )
        held = (found.ravel() > 0) & (moved >= 0).all(axis=1) & (moved < (width, height)).all(axis=1)
        if held.sum() < MIN_TRACKED:
            return self._lost(gray)
        state = _State(gray, before.rays, before.reference, moved).kept(held)
        affine, inliers = cv2.estimateAffine2D(state.reference, state.current, ransacReprojThreshold=RELIEF_MAX * width)
        if affine is None or inliers.sum() < max(MIN_TRACKED, AGREEING_MIN * len(inliers)):
            return self._lost(gray)
        self._state = state.kept(inliers.ravel() > 0)
        return Track(_shared_area(affine, width, height), self._parallax(), len(self._state.current))

    def undo(self) -> None:
        """Forgets the last frame tracked: a covered lens or a dark second must not lose the corners."""
        self._state = self._undo

    def _lost(self, gray: GrayImage) -> Track:
        none = np.zeros(len(self._state.current), bool)
        self._state = replace(self._state.kept(none), image=gray)
        return Track(0.0, float("nan"), 0)

    def _unit_rays(self, points: PointArray, width: int) -> FloatArray:
        """(N, 3) directions of (N, 2) points of the reduced image."""
        camera = self._camera
        pixels = camera.undistort_points((points + 0.5) * (camera.width / width) - 0.5)
        rays = np.ones((len(points), 3))
        rays[:, :2] = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        return rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]

    def _parallax(self) -> float:
        """Median displacement that no rotation of the camera explains [px of the full image]."""
        reference = self._state.rays
        current = self._unit_rays(self._state.current, self._state.image.shape[1])
        weights = np.ones(len(reference))
        for _ in range(KABSCH_ROUNDS):  # reweighted: near points, which move most, must not turn the far ones
            u, _, vt = np.linalg.svd((current.T * weights) @ reference)
            if np.linalg.det(u @ vt) < 0:
                u[:, 2] = -u[:, 2]
            difference = current - reference @ (u @ vt).T
            residual = np.sqrt(np.einsum("ij,ij->i", difference, difference))
            weights = 1.0 / np.maximum(residual, 1e-4)
        return float(np.partition(residual, len(residual) // 2)[len(residual) // 2]) * self._camera.fx
