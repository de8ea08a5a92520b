"""The one module that imports pycolmap, and the one place where the half pixel between ROS and COLMAP is crossed.

ROS and OpenCV put pixel centres at integers, COLMAP puts the corner of the first pixel at zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2  # noqa: F401  # before pycolmap: loaded after it, OpenCV's PNG writer frees memory of another zlib
import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera

FloatArray = NDArray[np.float64]

HALF_PIXEL = 0.5


@dataclass(frozen=True)
class RelativePose:
    """b_from_a (4, 4) with a baseline of 1, and the matches (M,) bool that agree with it."""

    b_from_a: FloatArray
    inliers: NDArray[np.bool_]


@dataclass(frozen=True)
class AbsolutePose:
    """camera_from_model (4, 4), and the correspondences (M,) bool that agree with it."""

    camera_from_model: FloatArray
    inliers: NDArray[np.bool_]


def relative_pose(
    pixels_a: NDArray[np.float32],
    pixels_b: NDArray[np.float32],
    camera_a: Camera,
    camera_b: Camera,
    max_error: float,
    seed: int,
) -> RelativePose | None:
    """Essential matrix of (M, 2) matched pixels by LO-RANSAC, max_error in px; None without a pose."""
    ransac = pycolmap.RANSACOptions(
        max_error=max_error, random_seed=seed, min_num_trials=100, max_num_trials=2000, confidence=0.9999
    )
    result = pycolmap.estimate_essential_matrix(
        _pixels(pixels_a), _pixels(pixels_b), _camera(camera_a), _camera(camera_b), ransac
    )
    if result is None:
        return None
    return RelativePose(_matrix(result["cam2_from_cam1"]), np.asarray(result["inlier_mask"], bool))


def absolute_pose(
    pixels: NDArray[np.float32], points_in_model: FloatArray, camera: Camera, max_error: float, seed: int
) -> AbsolutePose | None:
    """Pose from (M, 2) pixels of (M, 3) points by LO-RANSAC and refinement, max_error in px; None without a pose."""
    if len(pixels) < 4:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = pycolmap.RANSACOptions(
        max_error=max_error, random_seed=seed, min_num_trials=30, max_num_trials=3000, confidence=0.9999
    )
    result = pycolmap.estimate_and_refine_absolute_pose(_pixels(pixels), points_in_model, _camera(camera), options)
    if result is None:
        return None
    return AbsolutePose(_matrix(result["cam_from_world"]), np.asarray(result["inlier_mask"], bool))


def _matrix(transform: pycolmap.Rigid3d) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3] = transform.matrix()
    return matrix


def _pixels(pixels: NDArray[np.float32]) -> FloatArray:
    return pixels.astype(np.float64) + HALF_PIXEL


def _camera(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL],
    )
