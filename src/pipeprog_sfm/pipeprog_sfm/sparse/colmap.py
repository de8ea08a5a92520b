# SPDX-License-Identifier: Apache-2.0
"""The one module that imports pycolmap, and the one place where the half pixel between ROS and COLMAP is crossed.

ROS and OpenCV put pixel centres at integers, COLMAP puts the corner of the first pixel at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2  # noqa: F401  # before pycolmap: loaded after it, OpenCV's PNG writer frees memory of another zlib
import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera

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


@dataclass(frozen=True)
class ModelView:
    """One image of a model to be written.

    Attributes:
        name: of its file.
        camera: calibration.
        camera_from_map: (4, 4), m.
        pixels: (K, 2) what it sees of the points, in the ideal pinhole image.
        points: (K,) int, rows of the points.
    """

    name: str
    camera: Camera
    camera_from_map: FloatArray
    pixels: FloatArray
    points: NDArray[np.int64]


def write_model(folder: Path, views: Sequence[ModelView], points_in_map: FloatArray) -> None:
    """A COLMAP model, binary and as text, of (P, 3) points each of which two views or more see.

    The cameras have their lens distortion, and the pixels are those of the images as the camera saw them.
    """
    model = pycolmap.Reconstruction()
    numbers: dict[Camera, int] = {}
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points_in_map]
    for image_id, view in enumerate(views, 1):
        if view.camera not in numbers:
            numbers[view.camera] = len(numbers) + 1
            camera = _distorted_camera(view.camera)
            camera.camera_id = numbers[view.camera]
            model.add_camera_with_trivial_rig(camera)
        keypoints = view.camera.distort_points(view.pixels) + HALF_PIXEL
        image = pycolmap.Image(name=view.name, keypoints=keypoints, camera_id=numbers[view.camera], image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.camera_from_map[:3]))
        for number, point in enumerate(view.points.tolist()):
            tracks[point].append(pycolmap.TrackElement(image_id, number))
    for place, track in zip(points_in_map, tracks, strict=True):
        model.add_point3D(place, pycolmap.Track(track))
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    model.write_text(folder)


def _distorted_camera(camera: Camera) -> pycolmap.Camera:
    """With the distortion that COLMAP knows by the same coefficients."""
    if not camera.is_distorted:
        return _camera(camera)
    matrix = [camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL]
    if camera.distortion_model == "equidistant":
        name, count = "OPENCV_FISHEYE", 4
    else:
        name, count = "FULL_OPENCV", 8
    distortion = [*camera.distortion, *[0.0] * count][:count]
    return pycolmap.Camera(model=name, width=camera.width, height=camera.height, params=matrix + distortion)


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
