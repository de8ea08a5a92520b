# SPDX-License-Identifier: Apache-2.0
"""Stereo between images of a rolling shutter: each pixel of the reference is seen from the pose of its row's moment.

Without a rolling shutter a pixel x of inverse depth i lies at H x + i e of a neighbour. Here H and e are those of the
pose at the time t of the pixel's row, and the neighbour has turned and moved on until its own row's time s:

    (I + s A + s^2 B) (H(t) x + i e(t)) + i s a,    H(t) = H + t H1 + t^2 H2,    e(t) = e + t e1 + t^2 e2.

The series of the rotation ends at the square: the cube is below 0.001 px at 1 rad/s and a read-out of 30 ms.
Accelerations are left out: 3 m/s^2 move a point by 0.15 mm in 10 ms, less than depth is known to.
The neighbour's time follows from where the point is seen, which follows from the time: one fixed-point step from the
row at the stamp leaves the square of the pixels that the image moves while one row is read, 0.1 px at worst.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage, row_of, seen_after
from pipeprog_sfm.dense.depth_sampling import depth_at

# Steps at most from a pixel at the stamp to where the image shows it: each leaves 0.3 of the error at worst (see
# `rolled_image`), and a first one of 10 px is then below _FOUND. The depth is looked up anew in each.
_STEPS = 6
# A pixel that a step moves by less [px] is found: at most half of that is left of the error.
_FOUND = 0.01
# The last step moves a pixel by less than this [px], or the pixel is hidden at the stamp: a contour lies between.
_SETTLED = 0.5
# Relative difference of depth up to which neighbouring pixels lie on one surface.
_SAME_SURFACE = 0.01


class RowMapping(NamedTuple):
    """From pixels of a reference to N neighbours, both with rolling shutters; float32, see the module.

    Attributes:
        times: (h, w) of the reference's pixels [s].
        turned: H1 and H2 (N, 2, 3, 3).
        moved: e1 and e2 (N, 2, 3).
        other_times: (N, h2, w2) of the neighbours' pixels [s].
        other_clocks: (N, 2) time of their first row, and from one row to the next [s], without the lens's distortion.
        other_turned: A and B (N, 2, 3, 3).
        other_moved: a (N, 3).
    """

    times: NDArray[np.float32]
    turned: NDArray[np.float32]
    moved: NDArray[np.float32]
    other_times: NDArray[np.float32]
    other_clocks: NDArray[np.float32]
    other_turned: NDArray[np.float32]
    other_moved: NDArray[np.float32]

    def thinned(self, stride: int) -> RowMapping:
        """The mapping from every `stride`-th pixel of the reference, counted anew."""
        wider = np.diag([stride, stride, 1]).astype(np.float32)
        return self._replace(times=np.ascontiguousarray(self.times[::stride, ::stride]), turned=self.turned @ wider)


def row_mapping(
    reference: RolledImage, neighbours: Sequence[RolledImage], others_from_reference: Sequence[FloatArray]
) -> RowMapping:
    """The mapping; (4, 4) poses of the stamps, in the unit of the motions."""
    spin = _cross(reference.motion.angular)
    inverse = np.linalg.inv(reference.camera.matrix)
    turned, moved, other_turned, other_moved = [], [], [], []
    for neighbour, pose in zip(neighbours, others_from_reference, strict=True):
        matrix = neighbour.camera.matrix
        rotated = matrix @ pose[:3, :3]
        turned.append([-rotated @ spin @ inverse, 0.5 * rotated @ spin @ spin @ inverse])
        moved.append([-rotated @ reference.motion.linear, rotated @ spin @ reference.motion.linear])
        other_spin, other_inverse = _cross(neighbour.motion.angular), np.linalg.inv(matrix)
        other_turned.append(
            [matrix @ other_spin @ other_inverse, 0.5 * matrix @ other_spin @ other_spin @ other_inverse]
        )
        other_moved.append(matrix @ neighbour.motion.linear)
    times = np.stack([pixel_times(neighbour) for neighbour in neighbours])
    clocks = [neighbour.numbers[[5, 4]] for neighbour in neighbours]
    first, second, *others = (
        np.array(values, np.float32) for values in (turned, moved, clocks, other_turned, other_moved)
    )
    return RowMapping(pixel_times(reference), first, second, times, *others)


def pixel_times(image: RolledImage) -> NDArray[np.float32]:
    """(h, w) float32: when the pixels of an undistorted image are exposed, s after the stamp."""
    return _pixel_times(image.camera, image.motion.readout)


@lru_cache(maxsize=4)
def _pixel_times(camera: Camera, readout: float) -> NDArray[np.float32]:
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rows = camera.distort_points(np.stack([u.ravel(), v.ravel()], axis=1))[:, 1].reshape(u.shape)
    return (((rows + 0.5) / camera.height - 0.5) * readout).astype(np.float32)


def _cross(vector: FloatArray) -> FloatArray:
    """(3, 3) matrix of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


# What takes a mapping is inlined: a call copies all that it holds, which takes as long as the patch itself.
@njit(cache=True, nogil=True, inline="always", fastmath=True, error_model="numpy")
def at_row(homography, epipole, rows, n, u, v, turned, moved):  # type: ignore[no-untyped-def]
    """Writes H(t) x and e(t) of neighbour n, for the pixel x = (u, v) and the time t of its row, to two (3,)."""
    time = rows.times[v, u]
    square = time * time
    h, first, second = homography, rows.turned[n, 0], rows.turned[n, 1]
    for i in range(3):
        still = h[i, 0] * u + h[i, 1] * v + h[i, 2]
        linear = first[i, 0] * u + first[i, 1] * v + first[i, 2]
        squared = second[i, 0] * u + second[i, 1] * v + second[i, 2]
        turned[i] = still + time * linear + square * squared
        moved[i] = epipole[i] + time * rows.moved[n, 0, i] + square * rows.moved[n, 1, i]


@njit(cache=True, nogil=True, inline="always", fastmath=True, error_model="numpy")
def at_other_row(turned, moved, rows, n, inverse):  # type: ignore[no-untyped-def]
    """Homogeneous pixel (3) of neighbour n, at the time of its own row, and its derivative (3) by the inverse depth.

    `turned` and `moved` (3,) are from `at_row`; the derivative is up to the square of the turn. The row is found in one
    step from that of the stamp, which leaves 0.01 px.
    """
    a, b, shift = rows.other_turned[n, 0], rows.other_turned[n, 1], rows.other_moved[n]
    px, py, pz = turned[0] + inverse * moved[0], turned[1] + inverse * moved[1], turned[2] + inverse * moved[2]
    rx = a[0, 0] * px + a[0, 1] * py + a[0, 2] * pz + inverse * shift[0]
    ry = a[1, 0] * px + a[1, 1] * py + a[1, 2] * pz + inverse * shift[1]
    rz = a[2, 0] * px + a[2, 1] * py + a[2, 2] * pz + inverse * shift[2]
    time = rows.other_clocks[n, 0] + rows.other_clocks[n, 1] * py / pz
    scale = np.float32(1.0) / (pz + time * rz)
    time = time_at(rows.other_times[n], (px + time * rx) * scale, (py + time * ry) * scale)
    square = time * time
    x = px + time * rx + square * (b[0, 0] * px + b[0, 1] * py + b[0, 2] * pz)
    y = py + time * ry + square * (b[1, 0] * px + b[1, 1] * py + b[1, 2] * pz)
    z = pz + time * rz + square * (b[2, 0] * px + b[2, 1] * py + b[2, 2] * pz)
    ex, ey, ez = moved[0], moved[1], moved[2]
    dx = ex + time * (a[0, 0] * ex + a[0, 1] * ey + a[0, 2] * ez + shift[0])
    dy = ey + time * (a[1, 0] * ex + a[1, 1] * ey + a[1, 2] * ez + shift[1])
    dz = ez + time * (a[2, 0] * ex + a[2, 1] * ey + a[2, 2] * ez + shift[2])
    return x, y, z, dx, dy, dz


@njit(cache=True, nogil=True, inline="always", fastmath=True, error_model="numpy")
def time_at(times, x, y):  # type: ignore[no-untyped-def]
    """When the pixel nearest to (x, y) is exposed; beyond the image that at its border [s]."""
    height, width = times.shape
    return times[np.int64(min(max(y, 0.0), height - 1.0) + 0.5), np.int64(min(max(x, 0.0), width - 1.0) + 0.5)]


def depth_at_the_stamp(
    depth: NDArray[np.float32], image: RolledImage, stride: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A depth map of rolling rows, seen from the pose of the stamp, and where its pixels come from.

    Args:
        depth: (h, w) on the optical axis of each row's own pose, NaN where unknown.
        image: the rolling shutter, in the unit of depth.
        stride: each pixel (u, v) of the depth map is pixel (stride * u, stride * v) of the image.

    Returns:
        (h, w) depth on the optical axis at the stamp, and (h, w, 2) float32 pixels (u, v) of the given one.
    """
    known = depth[np.isfinite(depth)]
    typical = float(np.median(known)) if len(known) else 1.0
    # Of focal lengths and centre, of s per row; without accelerations, as in the mapping.
    coarser = np.array([1.0 / stride] * 4 + [stride] + [1.0] * 7 + [0.0] * 6)
    return _at_the_stamp(depth, typical, image.numbers * coarser, image.rows / stride)


@njit(cache=True, nogil=True)
def _at_the_stamp(depth, typical, numbers, rows):  # type: ignore[no-untyped-def]
    """See `depth_at_the_stamp`; `typical`: depth where the search starts if nothing is known."""
    height, width = depth.shape
    result = np.full((height, width), np.nan, np.float32)
    places = np.zeros((height, width, 2), np.float32)
    for v in range(height):
        there = typical
        right, down = 0.0, 0.0  # from a pixel to where the image shows it: little changes from one to the next
        for u in range(width):
            if depth[v, u] > 0.0:
                there = float(depth[v, u])
            x, y = _step(u, v, there, u + right, v + down, numbers, rows)
            is_shown = False
            for _ in range(_STEPS):
                z = np.float64(depth_at(depth, x, y, _SAME_SURFACE))
                is_shown = bool(z > 0.0)
                if not is_shown:
                    break
                there = _depth_at_stamp(x, y, z, numbers, rows)
                before_x, before_y = x, y
                x, y = _step(u, v, there, x, y, numbers, rows)
                step = max(abs(x - before_x), abs(y - before_y))
                is_shown = step < _SETTLED
                if step < _FOUND:
                    break
            if is_shown:
                result[v, u] = there
                places[v, u] = x, y
                right, down = x - u, y - v
    return result, places


@njit(cache=True, nogil=True)
def _step(u, v, depth, x, y, numbers, rows):  # type: ignore[no-untyped-def]
    """Where the image shows pixel (u, v) of the stamp, at a depth, if that is in the row of (x, y)."""
    time = numbers[5] + numbers[4] * row_of(x, y, numbers, rows)
    return seen_after(float(u), float(v), depth, time, numbers)


@njit(cache=True, nogil=True)
def _depth_at_stamp(u, v, z, numbers, rows):  # type: ignore[no-untyped-def]
    """Depth at the stamp of what lies at depth z on the axis of its row's pose, at pixel (u, v) there."""
    time = numbers[5] + numbers[4] * row_of(u, v, numbers, rows)
    x = (u - numbers[2]) / numbers[0] * z - time * numbers[6]
    y = (v - numbers[3]) / numbers[1] * z - time * numbers[7]
    far = z - time * numbers[8]
    a, b, c = -time * numbers[9], -time * numbers[10], -time * numbers[11]
    # The third row of Rodrigues' formula up to the square of the angle.
    return far + a * y - b * x + 0.5 * (a * (c * x - a * far) - b * (b * far - c * y))
