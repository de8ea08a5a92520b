# SPDX-License-Identifier: Apache-2.0
"""A rolling shutter: where a camera that moves while its rows are read out shows a point.

Geometry lives in the ideal pinhole image of the moment of the stamp, that of the middle row. A pixel of that image and
the pixel that the camera measures are related by the depth of what is seen, by `RowMotion`; `rolled_image` has the way
back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
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
        focal, centre = [camera.fx, camera.fy], [camera.cx, camera.cy]
        times = self.row_times(camera.distort_points(measured)[:, 1])
        return self.unrolled_rays((measured - centre) / focal, times, np.asarray(depths, float)) * focal + centre

    def unrolled_rays(self, rays: FloatArray, times: FloatArray, depths: FloatArray) -> FloatArray:
        """As `unrolled_pixels`, of (N, 2) normalised image coordinates whose rows are exposed `times` (N,) s later."""
        return np.asarray(_unrolled(rays, times, np.ascontiguousarray(depths), self.rates))

    @property
    def rates(self) -> FloatArray:
        """(4, 3) linear and angular velocity, and half of the linear and of the angular acceleration; for kernels."""
        halves = 0.5 * self.linear_acceleration, 0.5 * self.angular_acceleration
        return np.stack((self.linear, self.angular, *halves))


def check_readout(readout: float) -> None:
    """Raises InputError for a read-out [s] that no camera has."""
    if not 0.0 <= readout <= MAX_READOUT:
        raise InputError(
            f"a read-out of {readout:g} s: from the first row to the last a camera takes 0 (all rows at once) to "
            f"{MAX_READOUT:g} s; phones take 0.004 to 0.035 s"
        )


@njit(cache=True, nogil=True)
def _unrolled(rays, times, depths, rates):  # type: ignore[no-untyped-def]  # compiled
    """(N, 2) normalised image coordinates at the stamp of those (N, 2) of rows `times` (N,) after it.

    rates (4, 3): linear and angular velocity, and half of the accelerations.
    """
    found = np.empty_like(rays)
    for n in range(len(rays)):
        found[n] = unrolled_ray(rays[n, 0], rays[n, 1], times[n], depths[n], rates)
    return found


@njit(cache=True, nogil=True)
def unrolled_ray(x, y, time, depth, rates):  # type: ignore[no-untyped-def]  # compiled
    """One of `_unrolled`, for kernels."""
    right = (rates[0, 0] + rates[2, 0] * time) * time
    down = (rates[0, 1] + rates[2, 1] * time) * time
    ahead = (rates[0, 2] + rates[2, 2] * time) * time
    a = -(rates[1, 0] + rates[3, 0] * time) * time
    b = -(rates[1, 1] + rates[3, 1] * time) * time
    c = -(rates[1, 2] + rates[3, 2] * time) * time
    # Rodrigues' formula: the point and the shift turned back.
    angle = np.sqrt(a * a + b * b + c * c)
    whole = np.sin(angle) / angle if angle > 0.0 else 1.0
    half = np.sin(0.5 * angle) / (0.5 * angle) if angle > 0.0 else 1.0
    twice = 0.5 * half * half
    ray_x, ray_y, ray_z = _turned(a, b, c, whole, twice, x, y, 1.0)
    shift_x, shift_y, shift_z = _turned(a, b, c, whole, twice, right, down, ahead)
    # The point lies on the ray of its own moment; the length on it follows from its depth at the stamp.
    length = (depth + shift_z) / ray_z
    there = length * ray_z - shift_z
    return (length * ray_x - shift_x) / there, (length * ray_y - shift_y) / there


@njit(cache=True, nogil=True)
def _turned(a, b, c, whole, twice, x, y, z):  # type: ignore[no-untyped-def]  # compiled
    """A point turned by a rotation vector of length t; whole: sin(t) / t; twice: (1 - cos(t)) / t^2."""
    first_x, first_y, first_z = b * z - c * y, c * x - a * z, a * y - b * x
    second_x, second_y, second_z = b * first_z - c * first_y, c * first_x - a * first_z, a * first_y - b * first_x
    return (
        x + whole * first_x + twice * second_x,
        y + whole * first_y + twice * second_y,
        z + whole * first_z + twice * second_z,
    )
