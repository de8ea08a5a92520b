"""Predicts overlap and parallax with the last keyframe on a reduced image, in milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera

GrayImage = NDArray[np.uint8]
PointArray = NDArray[np.float32]

WORKING_WIDTH = 320  # wide enough for a few hundred corners; decoding a JPEG at 1/4 or 1/8 size skips most of its cost
MAX_CORNERS = 200
MIN_CORNERS = 30  # below this a hull and a median say nothing
MIN_TRACKED = 10  # an affine map takes three: the rest are witnesses
AGREEING_MIN = 0.4  # corners that slid agree by chance on some map: a minority is no evidence
RELIEF_MAX = 0.03  # share of the width by which near and far points may part from one affine map between keyframes
LK_WINDOW = (13, 13)
LK_LEVELS = 4  # reaches 13/2 * 2^4 = 104 px, a third of the width: a turn of 18 degrees between frames
LK_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)


def reduction(width: int) -> int:
    """By how much (1, 2, 4 or 8) an image of this width is reduced to come nearest above WORKING_WIDTH."""
    return max((factor for factor in (1, 2, 4, 8) if width // factor >= WORKING_WIDTH), default=1)


def is_cut_off(encoded: bytes) -> bool:
    """Whether these bytes are no whole image: the decoder paints the missing part of a JPEG grey and says nothing."""
    return not encoded or (encoded.startswith(b"\xff\xd8") and b"\xff\xd9" not in encoded[-64:])


def sharpness(gray: GrayImage) -> float:
    """Variance of the Laplacian; comparable among neighbouring frames only."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def corners(gray: GrayImage) -> PointArray:
    """(N, 2) corners to track, spread over the image."""
    found = cv2.goodFeaturesToTrack(gray, MAX_CORNERS, qualityLevel=0.01, minDistance=gray.shape[1] / 40)
    return np.empty((0, 2), np.float32) if found is None else found.reshape(-1, 2)


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


class Tracker:
    """Follows the corners of the last keyframe from frame to frame (pyramidal Lucas-Kanade)."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._previous: GrayImage = np.empty((0, 0), np.uint8)
        self._reference: PointArray = np.empty((0, 2), np.float32)
        self._current: PointArray = np.empty((0, 2), np.float32)
        self._undo = (self._previous, self._reference, self._current)

    def start(self, gray: GrayImage) -> int:
        """Makes (h, w) `gray` the keyframe; returns its number of corners."""
        self._previous = gray
        self._reference = self._current = corners(gray)
        return len(self._reference)

    def track(self, gray: GrayImage) -> Track:
        """Follows the corners into (h, w) `gray`; start() comes before."""
        self._undo = (self._previous, self._reference, self._current)
        height, width = gray.shape
        affine = None
        if len(self._current) >= MIN_TRACKED:
            moved, found, _ = cv2.calcOpticalFlowPyrLK(
                self._previous, gray, self._current, None, winSize=LK_WINDOW, maxLevel=LK_LEVELS, criteria=LK_CRITERIA
            )
            held = (found.ravel() > 0) & (moved >= 0).all(axis=1) & (moved < (width, height)).all(axis=1)
            self._reference, self._current = self._reference[held], moved[held]
        if len(self._current) >= MIN_TRACKED:
            affine, inliers = cv2.estimateAffine2D(
                self._reference, self._current, ransacReprojThreshold=RELIEF_MAX * width
            )
        self._previous = gray
        if affine is None or inliers.sum() < max(MIN_TRACKED, AGREEING_MIN * len(inliers)):
            return Track(0.0, float("nan"), 0)
        held = inliers.ravel() > 0
        self._reference, self._current = self._reference[held], self._current[held]
        return Track(_shared_area(affine, width, height), self._parallax(width), len(self._current))

    def undo(self) -> None:
        """Forgets the last frame tracked: a covered lens or a dark second must not lose the corners."""
        self._previous, self._reference, self._current = self._undo

    def _parallax(self, width: int) -> float:
        """Median displacement that no rotation of the camera explains [px of the full image]."""
        factor = self._camera.width / width
        rays = []
        for points in (self._reference, self._current):
            pixels = self._camera.undistort_points((points + 0.5) * factor - 0.5)
            plane = (pixels - (self._camera.cx, self._camera.cy)) / (self._camera.fx, self._camera.fy)
            ray = np.c_[plane, np.ones(len(plane))]
            rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        reference, current = rays
        weights = np.ones(len(reference))
        for _ in range(4):  # reweighted Kabsch: near points, which move most, must not turn the far ones
            u, _, vt = np.linalg.svd((current * weights[:, None]).T @ reference)
            rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
            residual = np.linalg.norm(current - reference @ rotation.T, axis=1)
            weights = 1.0 / np.maximum(residual, 1e-4)
        return float(np.median(residual)) * self._camera.fx
