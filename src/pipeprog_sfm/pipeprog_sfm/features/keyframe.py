# SPDX-License-Identifier: Apache-2.0
"""A keyframe as the mapper keeps it: features, calibration, and how much of the image the features cover."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.sift import Features

GRID = (32, 18)


@dataclass(frozen=True)
class Keyframe:
    """Features of one image.

    Attributes:
        stamp: time of the image [ns].
        features: of the ideal pinhole image; with a rolling shutter, where the middle row's camera has them.
        camera: calibration.
        rays: (N, 2) normalised image coordinates of the features.
        focal: (2,) focal lengths, px.
        hull: area of the features' convex hull, px^2.
        cells: of the grid over the image that hold a feature.
        measured: (N, 2) keypoints as they were found, with the rows' own times.
        frame: of the camera.
        motion: with which the features were unrolled; None where they are as measured.
    """

    stamp: int
    features: Features
    camera: Camera
    rays: FloatArray
    focal: FloatArray
    hull: float
    cells: int
    measured: NDArray[np.float32]
    frame: str = ""
    motion: RowMotion | None = None

    @staticmethod
    def of(stamp: int, features: Features, camera: Camera, frame: str = "") -> Keyframe:
        """A keyframe of an image whose features are known."""
        rays = (features.keypoints - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        hull, cells = hull_area(features.keypoints), grid_cells(features.keypoints, (camera.width, camera.height))
        focal = np.array([camera.fx, camera.fy])
        return Keyframe(stamp, features, camera, rays, focal, hull, cells, features.keypoints, frame)

    def unrolled(self, motion: RowMotion, depths: FloatArray) -> Keyframe:
        """The same with features where a camera whose rows are all exposed at the stamp would have them.

        depths (N,): of what the features show, in the unit of the motion.
        """
        keypoints = motion.unrolled_pixels(self.measured, depths, self.camera)
        rays = (keypoints - [self.camera.cx, self.camera.cy]) / self.focal
        features = replace(self.features, keypoints=keypoints.astype(np.float32))
        return replace(self, features=features, rays=rays, motion=motion)

    def measured_features(self) -> Features:
        """The features as they were found."""
        return replace(self.features, keypoints=self.measured)

    def with_camera(self, camera: Camera) -> Keyframe:
        """The same image with another calibration of it."""
        pixels = camera.undistort_points(self.camera.distort_points(self.measured)).astype(np.float32)
        return Keyframe.of(self.stamp, replace(self.features, keypoints=pixels), camera, self.frame)


def hull_area(pixels: NDArray[np.float32]) -> float:
    """Area of the convex hull of (N, 2) pixels."""
    return float(cv2.contourArea(cv2.convexHull(pixels))) if len(pixels) > 2 else 0.0


def grid_cells(pixels: NDArray[np.float32], size: tuple[int, int]) -> int:
    """Cells of a grid over an image of (width, height) that hold one of (N, 2) pixels."""
    column = (pixels[:, 0] * GRID[0] / size[0]).astype(int)
    row = (pixels[:, 1] * GRID[1] / size[1]).astype(int)
    return len(np.unique(row * GRID[0] + column))
