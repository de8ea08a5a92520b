# SPDX-License-Identifier: Apache-2.0
"""A calibrated camera, as sensor_msgs/CameraInfo describes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.encoded_image import check_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import (
    MAX_CORNER_SHIFT,
    MAX_DISTORTION_COEFFICIENTS,
    MAX_FOCAL,
    MAX_OFF_CENTRE,
    MAX_PIXEL_ASPECT,
    MIN_FOCAL,
)

# Number of coefficients that each ROS distortion model may carry.
DISTORTION_MODELS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
_ALIASES = {
    "": "plumb_bob",
    "radtan": "plumb_bob",
    "fisheye": "equidistant",
    "none": "plumb_bob",
    # RealSense's SDK; its inverse model is taken where the coefficients are zero, as those of most of its cameras are.
    "None": "plumb_bob",
    "Brown Conrady": "plumb_bob",
    "Kannala Brandt4": "equidistant",
}
_INVERSE = "Inverse Brown Conrady"


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with lens distortion; pixel centres lie at integer coordinates (ROS, OpenCV).

    Focal lengths and principal point are in pixels, distortion coefficients in OpenCV's order.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"camera size {self.width} x {self.height} is no image size: set width and height")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise InputError(
                f"camera is not calibrated (fx = {self.fx:g}, fy = {self.fy:g}): "
                "calibrate it and fill K of its CameraInfo"
            )
        model = _ALIASES.get(self.distortion_model, self.distortion_model)
        model = "plumb_bob" if model == _INVERSE and not any(self.distortion) else model
        if model not in DISTORTION_MODELS:
            raise InputError(
                f"unknown distortion model {self.distortion_model[:40]!r}: use one of {', '.join(DISTORTION_MODELS)}"
            )
        if len(self.distortion) > MAX_DISTORTION_COEFFICIENTS:
            raise InputError(
                f"{len(self.distortion)} distortion coefficients: no model has more than {MAX_DISTORTION_COEFFICIENTS}"
            )
        coefficients = tuple(float(value) for value in self.distortion)
        if len(coefficients) not in DISTORTION_MODELS[model] and any(coefficients):
            raise InputError(
                f"distortion model {model} takes {DISTORTION_MODELS[model]} coefficients, not {len(coefficients)}"
            )
        if not np.isfinite(coefficients).all():
            raise InputError(f"distortion coefficients {coefficients} are not finite: calibrate the camera again")
        object.__setattr__(self, "distortion_model", model)
        object.__setattr__(self, "distortion", coefficients)

    @classmethod
    def from_calibration(
        cls,
        width: int,
        height: int,
        k: ArrayLike,
        distortion_model: str = "plumb_bob",
        distortion: Sequence[float] = (),
    ) -> Camera:
        """Camera from the row-major (3, 3) or (9,) matrix K; raises InputError where it is none of a real camera."""
        matrix = np.asarray(k, float).reshape(3, 3)
        if not np.isfinite(matrix).all() or np.tril(matrix, -1).any():
            raise InputError(
                f"K = {matrix.ravel().tolist()} is no camera matrix: it is fx 0 cx, 0 fy cy, 0 0 1 by rows"
            )
        camera = cls(
            int(width),
            int(height),
            matrix[0, 0],
            matrix[1, 1],
            matrix[0, 2],
            matrix[1, 2],
            distortion_model,
            tuple(distortion),
        )
        _check_plausible(camera)
        return camera

    @property
    def matrix(self) -> FloatArray:
        """The (3, 3) matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any coefficient is not zero."""
        return any(self.distortion)

    def undistort_points(self, pixels: ArrayLike) -> FloatArray:
        """(N, 2) pixels of the image -> (N, 2) pixels of the ideal pinhole camera with the same K."""
        points = np.asarray(pixels, float).reshape(-1, 1, 2)
        if not self.is_distorted or not len(points):
            return points.reshape(-1, 2)
        coefficients = np.asarray(self.distortion)
        if self.distortion_model == "equidistant":
            return cv2.fisheye.undistortPoints(points, self.matrix, coefficients, P=self.matrix).reshape(-1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        return cv2.undistortPointsIter(points, self.matrix, coefficients, None, self.matrix, criteria).reshape(-1, 2)

    def distort_points(self, pixels: ArrayLike) -> FloatArray:
        """(N, 2) pixels of the ideal pinhole camera -> (N, 2) pixels of the image."""
        points = np.asarray(pixels, float).reshape(-1, 2)
        if not self.is_distorted or not len(points):
            return points
        rays = np.c_[(points[:, 0] - self.cx) / self.fx, (points[:, 1] - self.cy) / self.fy]
        coefficients = np.asarray(self.distortion)
        if self.distortion_model == "equidistant":
            return cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), self.matrix, coefficients).reshape(-1, 2)
        zero = np.zeros(3)
        return cv2.projectPoints(np.c_[rays, np.ones(len(rays))], zero, zero, self.matrix, coefficients)[0].reshape(
            -1, 2
        )

    def undistort_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image as the ideal pinhole camera with the same K and size sees it."""
        if not self.is_distorted:
            return image
        coefficients = np.asarray(self.distortion)
        if self.distortion_model == "equidistant":
            return cv2.fisheye.undistortImage(image, self.matrix, coefficients, Knew=self.matrix)
        return cv2.undistort(image, self.matrix, coefficients)

    def pinhole(self) -> Camera:
        """The ideal camera with the same K and no distortion."""
        return replace(self, distortion_model="plumb_bob", distortion=())

    def scaled(self, factor: float) -> Camera:
        """The camera of the image resized by `factor` (pixel areas align, so the half pixel scales too)."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )


def _check_plausible(camera: Camera) -> None:
    """Raises InputError for a calibration that no lens has: every measurement with it would be wrong."""
    check_size(camera.width, camera.height)
    width, height = camera.width, camera.height
    longer = max(width, height)
    focal = np.array([camera.fx, camera.fy])
    if (
        not (MIN_FOCAL * longer <= focal.min() and focal.max() <= MAX_FOCAL * longer)
        or focal.max() > MAX_PIXEL_ASPECT * focal.min()
    ):
        raise InputError(
            f"focal lengths of {camera.fx:g} and {camera.fy:g} pixels fit no lens before an image of "
            f"{width} x {height}: is the calibration in pixels, and for this size?"
        )
    place = np.array([camera.cx / width, camera.cy / height])  # 0 to 1 inside the image
    if place.min() < -MAX_OFF_CENTRE or place.max() > 1.0 + MAX_OFF_CENTRE:
        raise InputError(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) is far outside an image of {width} x {height}: "
            "calibrate the camera at the size that it sends"
        )
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    shift = np.hypot(*(camera.distort_points(corners) - corners).T).max()
    if not shift <= MAX_CORNER_SHIFT * np.hypot(width, height):  # NaN, too
        raise InputError(
            f"distortion coefficients {camera.distortion} move a corner of the image by {shift:.3g} pixels: "
            "calibrate the camera again"
        )


def check_whole_sensor(
    size: tuple[int, int], binning: tuple[int, int], offset: tuple[int, int], region: tuple[int, int]
) -> None:
    """Raises InputError where a CameraInfo is of binned pixels or of a region of the sensor: K would be another.

    All are (x, y) in pixels: the image's size, pixels that are one, the region's corner and its size (0: all of it).
    """
    is_part = any(offset) or any(part not in (0, whole) for part, whole in zip(region, size, strict=True))
    if max(binning) > 1 or is_part:
        raise InputError(
            f"CameraInfo has binning {binning[0]} x {binning[1]} and a region of interest of "
            f"{region[0]} x {region[1]} at ({offset[0]}, {offset[1]}): publish the calibration of the image as it is "
            "sent"
        )
