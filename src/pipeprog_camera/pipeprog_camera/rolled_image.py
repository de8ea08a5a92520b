# SPDX-License-Identifier: Apache-2.0
"""An undistorted image of a rolling shutter, where it is sampled: thousands of pixels at a time, compiled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolling_shutter import RowMotion

# Degree of the polynomial that tells the rows of a lens: a 70 degree lens with k1 = -0.3 to 0.1 row (2 microseconds).
_DEGREE = 7
# Positions across the image, each way, at which the polynomial is fitted.
_FITTED = 24
# 1e-6 px: a pixel that moves by less in a step is found. At most half of that is left of the error (see below), far
# less than the 0.01 px to which edges are told.
_SETTLED = 1e-6
# 16 steps at most: each multiplies the error by the pixels that the image moves while one row is read, 0.3 at worst
# (1.5 m/s and 1.5 rad/s about all axes, 0.8 m away), and 100 px times 0.3 to the 16th are 4e-7 px.
_MOST_STEPS = 16


@dataclass(frozen=True)
class RolledImage:
    """Where an undistorted image shows what the ideal pinhole camera, all of whose rows are exposed at the stamp, sees.

    Attributes:
        motion: of the scene while the image is read out.
        camera: the calibration with its distortion: a row is one of the image as the lens draws it.
    """

    motion: RowMotion
    camera: Camera

    @cached_property
    def numbers(self) -> FloatArray:
        """fx, fy, cx, cy, s per row, s of row 0 after the stamp, `RowMotion.rates` (4 x 3); for kernels."""
        first, second = self.motion.row_times([0.0, 1.0])
        lens = [self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy]
        return np.concatenate([lens, [second - first, first], self.motion.rates.ravel()])

    @cached_property
    def rows(self) -> FloatArray:
        """Coefficients (_DEGREE + 1, _DEGREE + 1) of the rows of the lens, (0, 0) without distortion; for kernels."""
        return _lens_rows(self.camera)

    def scaled(self, factor: float) -> RolledImage:
        """The image resized by `factor`."""
        camera = self.camera.scaled(factor)
        return RolledImage(replace(self.motion, height=camera.height), camera)

    def shown(self, pixels: FloatArray, depths: FloatArray) -> FloatArray:
        """Where the image shows (N, 2) what lies, at the stamp, at pixels (N, 2) at depths (N,) on the optical axis."""
        return _shown(pixels, depths, self.numbers, self.rows)

    def shown_beside(
        self, pixels: FloatArray, directions: tuple[FloatArray, ...], depths: FloatArray
    ) -> tuple[FloatArray, ...]:
        """Where the image shows pixels (N, 2) of the stamp, and the steps (N, 2) there for a pixel along directions.

        Args:
            pixels: (N, 2) at the stamp.
            directions: unit vectors (N, 2) each.
            depths: (N,) of what is seen there and beside it, along the optical axis.
        """
        return tuple(_shown_beside(pixels, np.stack(directions), depths, self.numbers, self.rows))


@dataclass(frozen=True)
class RowVelocities:
    """How the map moves, seen from M keyframes, while their rows are read out.

    Attributes:
        readout: from the first row to the last [s].
        linear: (M, 3) [m/s].
        angular: (M, 3) [rad/s].
        linear_acceleration: (M, 3) [m/s^2].
        angular_acceleration: (M, 3) [rad/s^2].
    """

    readout: float
    linear: FloatArray
    angular: FloatArray
    linear_acceleration: FloatArray
    angular_acceleration: FloatArray

    def rolled(self, index: int, camera: Camera) -> RolledImage:
        """Where the keyframe of that number, of that calibration, shows what its pose at the stamp would."""
        rates = self.linear, self.angular, self.linear_acceleration, self.angular_acceleration
        motion = RowMotion(self.readout, camera.height, *(rate[index] for rate in rates))
        return RolledImage(motion, camera)


@lru_cache(maxsize=8)
def _lens_rows(camera: Camera) -> FloatArray:
    """Polynomial in x and y (normalised image coordinates) of the row, less y's own, that the lens draws a pixel in."""
    if not camera.is_distorted:
        return np.zeros((0, 0))
    u, v = (
        side.ravel()
        for side in np.meshgrid(*(np.linspace(0, size - 1, _FITTED) for size in (camera.width, camera.height)))
    )
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    terms = np.stack([x**i * y**j for i, j in powers], axis=1)
    off = camera.distort_points(np.stack([u, v], axis=1))[:, 1] - v
    result = np.zeros((_DEGREE + 1, _DEGREE + 1))
    for (i, j), value in zip(powers, np.linalg.lstsq(terms, off, rcond=None)[0], strict=True):
        result[i, j] = value
    return result


@njit(cache=True, nogil=True)
def row_of(u: float, v: float, numbers: FloatArray, rows: FloatArray) -> float:
    """The row of the sensor that draws a pixel of the undistorted image."""
    result = v
    x, y = (u - numbers[2]) / numbers[0], (v - numbers[3]) / numbers[1]
    power = 1.0
    for i in range(len(rows)):
        inner = 0.0
        for j in range(rows.shape[1] - 1, -1, -1):
            inner = inner * y + rows[i, j]
        result += power * inner
        power *= x
    return result


@njit(cache=True, nogil=True)
def shown_at(u: float, v: float, depth: float, numbers: FloatArray, rows: FloatArray) -> tuple[float, float]:
    """Where the image shows what lies at pixel (u, v) at the stamp; `numbers` and `rows` of `RolledImage`."""
    return _shown_near(u, v, u, v, depth, numbers, rows)


@njit(cache=True, nogil=True)
def _shown_near(
    column: float, line: float, u: float, v: float, depth: float, numbers: FloatArray, rows: FloatArray
) -> tuple[float, float]:
    """`shown_at`, sought from (column, line) on."""
    for _ in range(_MOST_STEPS):
        left, above = column, line
        time = numbers[5] + numbers[4] * row_of(column, line, numbers, rows)
        column, line = seen_after(u, v, depth, time, numbers)
        if abs(column - left) + abs(line - above) < _SETTLED:
            break
    return column, line


@njit(cache=True, nogil=True)
def seen_after(u: float, v: float, depth: float, time: float, numbers: FloatArray) -> tuple[float, float]:
    """Where the ideal pinhole camera sees, `time` [s] after the stamp, what lies at pixel (u, v) at the stamp."""
    fx, fy, cx, cy = numbers[0], numbers[1], numbers[2], numbers[3]
    x, y = (u - cx) / fx * depth, (v - cy) / fy * depth
    a = time * (numbers[9] + time * numbers[15])
    b = time * (numbers[10] + time * numbers[16])
    c = time * (numbers[11] + time * numbers[17])
    # Rodrigues' formula; the series of sine and cosine are exact to 1e-7 up to 0.2 rad within one read-out.
    square = a * a + b * b + c * c
    sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    p, q, r = b * depth - c * y, c * x - a * depth, a * y - b * x
    far = depth + sine * r + cosine * (a * q - b * p) + time * (numbers[8] + time * numbers[14])
    column = fx * (x + sine * p + cosine * (b * r - c * q) + time * (numbers[6] + time * numbers[12])) / far + cx
    line = fy * (y + sine * q + cosine * (c * p - a * r) + time * (numbers[7] + time * numbers[13])) / far + cy
    return column, line


@njit(cache=True, nogil=True)
def _shown(pixels: FloatArray, depths: FloatArray, numbers: FloatArray, rows: FloatArray) -> FloatArray:
    """See `RolledImage.shown`."""
    result = np.empty((len(pixels), 2))
    for i in range(len(pixels)):
        result[i] = shown_at(pixels[i, 0], pixels[i, 1], depths[i], numbers, rows)
    return result


@njit(cache=True, nogil=True)
def _shown_beside(
    pixels: FloatArray, directions: FloatArray, depths: FloatArray, numbers: FloatArray, rows: FloatArray
) -> FloatArray:
    """(1 + D, N, 2): see `RolledImage.shown_beside`; directions (D, N, 2)."""
    result = np.empty((1 + len(directions), len(pixels), 2))
    for i in range(len(pixels)):
        u, v = pixels[i]
        column, line = shown_at(u, v, depths[i], numbers, rows)
        result[0, i, 0], result[0, i, 1] = column, line
        for k in range(len(directions)):
            across, down = directions[k, i]
            ahead = _shown_near(column + across, line + down, u + across, v + down, depths[i], numbers, rows)
            behind = _shown_near(column - across, line - down, u - across, v - down, depths[i], numbers, rows)
            result[1 + k, i, 0] = 0.5 * (ahead[0] - behind[0])
            result[1 + k, i, 1] = 0.5 * (ahead[1] - behind[1])
    return result
