# SPDX-License-Identifier: Apache-2.0
"""Predicts overlap and parallax with the last keyframe by tracking corners in reduced images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_frames.corners import PointArray, corners
from pipeprog_frames.incoming.decoding import GrayImage

MIN_CORNERS = 30  # in a keyframe: enough for a median after losing two thirds
MIN_TRACKED = 10  # corners: three determine an affine map, the others confirm it
AGREEING_MIN = 0.4  # of the tracked corners, on one affine map: fewer agree by chance where tracking slid
RELIEF_MAX = 0.03  # of the image width, distance from the affine map: parallax of near and far points moves them
# px. At the coarsest level it covers nearly half of the image's height; a larger one would reach beyond the edge.
# Eight pixels fill a SIMD register: nine take 1.2 times as long, seven twice.
LK_WINDOW = (8, 8)
LK_LEVELS = 4  # reaches 8/2 * 2^4 = 64 px, a fifth of the width: a turn of 14 degrees between frames
LK_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.1)  # px; 0.01 of overlap is 3 px
KABSCH_ROUNDS = 3  # of reweighting; more change the median by less than 1 px of the full image, limit: 51 px at 1280


def _shared_area(affine: FloatArray, width: int, height: int) -> float:
    """Share of the image that the keyframe's image covers after the (2, 3) map `affine`."""
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = (frame @ affine[:, :2].T + affine[:, 2]).astype(np.float32)
    return float(cv2.intersectConvexConvex(frame, moved)[0]) / (width * height)


def _fit_affine(points: PointArray, moved: PointArray) -> FloatArray:
    """The (2, 3) affine map that brings (N, 2) points nearest to where they moved, by least squares."""
    design = np.ones((len(points), 3))
    design[:, :2] = points
    affine: FloatArray = np.linalg.solve(design.T @ design, design.T @ moved.astype(float)).T
    return affine


@dataclass(frozen=True)
class Track:
    """Relation of a frame to the keyframe: overlap, 0 to 1; parallax, px of the full image; number of corners."""

    overlap: float
    parallax: float
    tracked: int


@dataclass(frozen=True)
class _State:
    """The last image and the corners tracked into it."""

    image: GrayImage
    rays: FloatArray  # (N, 3) in the keyframe
    reference: PointArray  # (N, 2) in the keyframe
    current: PointArray  # (N, 2) in the image

    def kept(self, held: NDArray[np.bool_]) -> _State:
        return _State(self.image, self.rays[held], self.reference[held], self.current[held])


class Tracker:
    """Follows the corners of the last keyframe from frame to frame (pyramidal Lucas-Kanade)."""

    def __init__(self, camera: Camera) -> None:
        self._camera = self._reduced = camera
        none = np.empty((0, 2), np.float32)
        self._state = self._undo = _State(np.empty((0, 0), np.uint8), np.empty((0, 3)), none, none)

    def start(self, gray: GrayImage) -> int:
        """Makes (h, w) `gray` the keyframe; returns its number of corners."""
        found = corners(gray)
        if self._reduced.width != gray.shape[1]:
            self._reduced = self._camera.scaled(gray.shape[1] / self._camera.width)
        self._state = _State(gray, self._unit_rays(found), found, found)
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
        affine, inliers = cv2.estimateAffine2D(
            state.reference, state.current, ransacReprojThreshold=RELIEF_MAX * width, refineIters=0
        )
        if affine is None or inliers.sum() < max(MIN_TRACKED, AGREEING_MIN * len(inliers)):
            return self._lost(gray)
        self._state = state = state.kept(inliers.ravel() > 0)
        affine = _fit_affine(state.reference, state.current)
        return Track(_shared_area(affine, width, height), self._parallax(), len(state.current))

    def undo(self) -> None:
        """Returns to the state before the last frame tracked, such as one that a hand covered."""
        self._state = self._undo

    def _lost(self, gray: GrayImage) -> Track:
        none = np.zeros(len(self._state.current), bool)
        self._state = replace(self._state.kept(none), image=gray)
        return Track(0.0, float("nan"), 0)

    def _unit_rays(self, points: PointArray) -> FloatArray:
        """(N, 3) directions of (N, 2) points of the reduced image."""
        camera = self._reduced
        return _directions(camera.undistort_points(points), camera.fx, camera.fy, camera.cx, camera.cy)

    def _parallax(self) -> float:
        """Median displacement that no rotation of the camera explains [px of the full image]."""
        return _unexplained(self._state.rays, self._unit_rays(self._state.current)) * self._camera.fx


@njit(cache=True)
def _directions(pixels: FloatArray, fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """(N, 3) unit rays through (N, 2) pixels of a pinhole camera."""
    rays = np.empty((len(pixels), 3))
    for n in range(len(pixels)):
        x, y = (pixels[n, 0] - cx) / fx, (pixels[n, 1] - cy) / fy
        norm = np.sqrt(x * x + y * y + 1.0)
        rays[n, 0], rays[n, 1], rays[n, 2] = x / norm, y / norm, 1.0 / norm
    return rays


@njit(cache=True)
def _unexplained(reference: FloatArray, current: FloatArray) -> float:
    """Median distance [-] of (N, 3) unit rays from those of the keyframe, rotated to fit best (Kabsch, reweighted)."""
    residual = np.zeros(len(reference))
    weights = np.ones(len(reference))
    for _ in range(KABSCH_ROUNDS):  # reweighted, since the parallax of near points must not bias the rotation
        covariance = np.zeros((3, 3))
        for n in range(len(reference)):
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += weights[n] * current[n, i] * reference[n, j]
        u, _, vt = np.linalg.svd(covariance)
        if np.linalg.det(u) * np.linalg.det(vt) < 0:
            u[:, 2] = -u[:, 2]
        rotation = u @ vt
        for n in range(len(reference)):
            square = 0.0
            for i in range(3):
                turned = (
                    rotation[i, 0] * reference[n, 0]
                    + rotation[i, 1] * reference[n, 1]
                    + rotation[i, 2] * reference[n, 2]
                )
                square += (current[n, i] - turned) ** 2
            residual[n] = np.sqrt(square)
            weights[n] = 1.0 / max(residual[n], 1e-4)
    return np.partition(residual, len(residual) // 2)[len(residual) // 2]
