# SPDX-License-Identifier: Apache-2.0
"""A rolling shutter: where a camera that moves while its rows are read out shows a point.

Geometry lives in the ideal pinhole image of the moment of the stamp, that of the middle row. A pixel of that image and
the pixel that the camera measures are related by the depth of what is seen, by `RowMotion`; `rolled_image` has the way
back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_READOUT


@dataclass(frozen=True)
class RowMotion:
    """How the scene moves, seen from the camera, while one image is read out.

    A point that is at P at the stamp is at exp([angular]x t) P + linear t in the camera's frame, t later; with their
    accelerations, each velocity stands for its mean over t, which differs by half of the acceleration times t.

    Attributes:
        readout: from the first row to the last, s; 0: all rows at once.
        height: rows of the image.
        linear: (3,) float64, m/s, or model units per second.
        angular: (3,) float64, rad/s.
        linear_acceleration: (3,) float64, m/s^2.
        angular_acceleration: (3,) float64, rad/s^2.
    """

    readout: float
    height: int
    linear: FloatArray
    angular: FloatArray
    linear_acceleration: FloatArray = field(default_factory=lambda: np.zeros(3))
    angular_acceleration: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        check_readout(self.readout)
        rates = {"linear velocity": self.linear, "angular velocity": self.angular}
        rates |= {"linear acceleration": self.linear_acceleration, "angular acceleration": self.angular_acceleration}
        for name, value in rates.items():
            if np.shape(value) != (3,) or not np.isfinite(value).all():
                raise InputError(f"the {name} of an image is {value}: it is three finite numbers")

    def row_times(self, rows: ArrayLike) -> FloatArray:
        """When rows (pixel centres at integers) are exposed, s after the stamp, which is that of the middle row."""
        return ((np.asarray(rows, float) + 0.5) / self.height - 0.5) * self.readout

    def unrolled_pixels(self, pixels: ArrayLike, depths: ArrayLike, camera: Camera) -> FloatArray:
        """Where an image whose rows are all exposed at the stamp shows what is measured; undoes `RolledImage.shown`.

        Args:
            pixels: (N, 2) measured, in the ideal pinhole image with rolling rows.
            depths: (N,) of what is seen, along the optical axis at the stamp, in the unit of `linear`.
            camera: calibration; a row is one of the image as the lens draws it.
        """
        measured = np.asarray(pixels, float).reshape(-1, 2)
        if self.readout == 0.0:
            return measured
        times = self.row_times(camera.distort_points(measured)[:, 1])[:, None]
        rays = np.c_[(measured - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(measured))]
        back = -(self.angular + 0.5 * self.angular_acceleration * times) * times
        rays = _turned(back, rays)
        shifts = _turned(back, (self.linear + 0.5 * self.linear_acceleration * times) * times)
        # The point lies on the ray of its own moment; the length on it follows from its depth at the stamp.
        lengths = (np.asarray(depths, float) + shifts[:, 2]) / rays[:, 2]
        return _projected(lengths[:, None] * rays - shifts, camera)


def check_readout(readout: float) -> None:
    """Raises InputError for a read-out [s] that no camera has."""
    if not 0.0 <= readout <= MAX_READOUT:
        raise InputError(
            f"a read-out of {readout:g} s: from the first row to the last a camera takes 0 (all rows at once) to "
            f"{MAX_READOUT:g} s; phones take 0.004 to 0.035 s"
        )


def _projected(points: FloatArray, camera: Camera) -> FloatArray:
    return points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _turned(turns: FloatArray, points: FloatArray) -> FloatArray:
    """(N, 3) points turned by (N, 3) rotation vectors (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=1)[:, None]
    cross = np.cross(turns, points)
    half = np.sinc(angle / (2 * np.pi))
    return points + np.sinc(angle / np.pi) * cross + 0.5 * half * half * np.cross(turns, cross)
