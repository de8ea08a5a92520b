# SPDX-License-Identifier: Apache-2.0
"""The apparent contour of a circular cylinder: its two image lines in a view, and how they move with it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.types import Cylinder, View

# Nearer to the camera than this [m] nothing is projected: closer than any camera of the project focuses.
NEAR_PLANE = 0.05
# Positions along the axis are equal to a micrometre: samples of all views share them but for rounding.
POSITION_DIGITS = 6
# Samples of one side that are fewer than this share of the other's are gaps between the cylinders that hide it.
GAPS = 0.1


@dataclass(frozen=True)
class ContourSamples:
    """N positions on the predicted apparent contour of one cylinder in several views, where edges are sought.

    Attributes:
        view: index (N,) of the view.
        side: 0 or 1 (N,), which of the two lines.
        pixel: (N, 2) [px].
        normal: (N, 2) unit vectors across the line, outwards from the pipe.
        along: position (N,) on the axis from the cylinder's middle [m].
        gain: displacement (N,) of the line for one metre of the surface [px/m].
        half_width: apparent radius (N,) of the pipe [px].
        depth: of the surface there (N,), along the optical axis [m].
        jacobian: (N, 5) outward displacement [px] for one metre of each component of a step: offsets along the basis
            of the axis' start (2) and end (2), and of the radius.
    """

    view: IntArray
    side: IntArray
    pixel: FloatArray
    normal: FloatArray
    along: FloatArray
    gain: FloatArray
    half_width: FloatArray
    depth: FloatArray
    jacobian: FloatArray

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: NDArray[np.bool_] | IntArray) -> ContourSamples:
        """Those that a mask or an index array names."""
        return ContourSamples(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def thinned(self, limit: int) -> ContourSamples:
        """At most `limit` of them and at least half as many, evenly spread; all where there are fewer."""
        return self.select(np.arange(0, len(self), max(-(-len(self) // limit), 1)))

    def sideways(self) -> FloatArray:
        """Sign (N,) of the outward displacement that a shift of the whole pipe towards side 0 causes."""
        return np.where(self.side == 0, 1.0, -1.0)

    def shows_both_sides(self) -> bool:
        """Whether they lie on both sides, more of them than gaps in what hides one side let through."""
        count = np.bincount(self.side, minlength=2)
        return bool(count.min() > GAPS * count.max())

    def positions(self) -> tuple[FloatArray, IntArray]:
        """The distinct positions (B,) along the axis [m], and the index (N,) of each sample's own among them."""
        along, index = np.unique(np.round(self.along, POSITION_DIGITS), return_inverse=True)
        return along, index.astype(np.int64)


def parts_by_view(samples: ContourSamples, views: int) -> Iterator[tuple[int, slice]]:
    """The views that show some of the samples, each with these; samples come view by view."""
    bounds = np.searchsorted(samples.view, np.arange(views + 1)).tolist()
    for index, (first, last) in enumerate(itertools.pairwise(bounds)):
        if last > first:
            yield index, slice(first, last)


def project(view: View, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and depths (N,) [m] of points (N, 3) of the map."""
    in_camera = points @ view.camera_from_map[:3, :3].T + view.camera_from_map[:3, 3]
    depth = np.ascontiguousarray(in_camera[:, 2])
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    camera = view.camera
    pixel = np.stack(
        [camera.fx * in_camera[:, 0] / safe + camera.cx, camera.fy * in_camera[:, 1] / safe + camera.cy], axis=1
    )
    return pixel, depth


def in_image(view: View, points: FloatArray, margin: float = 0.0) -> NDArray[np.bool_]:
    """Mask (N,) of the points (N, 3) of the map that lie before the camera and `margin` [px] within the image."""
    pixel, depth = project(view, points)
    last = np.array([view.camera.width, view.camera.height]) - 1
    return np.asarray((depth > NEAR_PLANE) & (pixel > margin).all(axis=1) & (pixel < last - margin).all(axis=1))


@dataclass(frozen=True)
class ViewArrays:
    """What `View.geometry` tells of V views: poses (V, 3, 4), lenses (V, 4), sizes (V, 2) and centres (V, 3)."""

    poses: FloatArray
    lenses: FloatArray
    sizes: FloatArray
    centres: FloatArray

    @classmethod
    def of(cls, views: Sequence[View]) -> ViewArrays:
        """Those of the views, in their order."""
        rows = np.concatenate([view.geometry for view in views]).reshape(len(views), -1)
        # Contiguous: of one view slices are so anyway, and compiled code would be compiled for either.
        poses, lenses, sizes, centres = (np.ascontiguousarray(part) for part in np.split(rows, [12, 16, 18], axis=1))
        return cls(poses.reshape(-1, 3, 4), lenses, sizes, centres)

    def pixels_per_metre(self, point: FloatArray) -> FloatArray:
        """Width (V,) in the images [px] of one metre across the line of sight at a point (3,) of the map."""
        distance = np.sqrt(((self.centres - point) ** 2).sum(axis=1))
        return np.asarray(self.lenses[:, 0] / np.maximum(distance, 1e-3), np.float64)

    def showing(self, points: FloatArray) -> NDArray[np.bool_]:
        """Mask (V,) of the views in which some of the points (N, 3) of the map lie."""
        in_camera = np.einsum("vik,nk->ivn", self.poses[:, :, :3], points) + self.poses[:, :, 3].T[:, :, None]
        depth = np.maximum(in_camera[2], NEAR_PLANE)
        inside = in_camera[2] > NEAR_PLANE
        for k in (0, 1):
            pixel = self.lenses[:, k, None] * in_camera[k] / depth + self.lenses[:, k + 2, None]
            inside &= (pixel > 0) & (pixel < self.sizes[:, k, None] - 1)
        return np.asarray(inside.any(axis=1), bool)


def views_showing(points: FloatArray, views: Sequence[View], most: int) -> list[View]:
    """The views that show some of the points (N, 3) of the map, evenly thinned to `most` at the most."""
    able = [views[index] for index in np.flatnonzero(ViewArrays.of(views).showing(points))] if views else []
    return able[:: -(-len(able) // most)] if able else []


def contour_samples(
    cylinder: Cylinder, views: Sequence[View], basis: FloatArray, spacing: float, margin: float = 4.0
) -> ContourSamples:
    """Samples farther than `margin` [px] inside the images, about `spacing` [px] apart in the median view.

    The positions along the axis are common to all views, so that evidence can be pooled by position. `basis` (2, 3):
    the directions across the axis of which the Jacobian is taken.
    """
    arrays = ViewArrays.of(views)
    step = spacing / float(np.median(arrays.pixels_per_metre(cylinder.middle)))
    count = max(int(cylinder.length / step), 4)
    fractions = (np.arange(count) + 0.5) / count
    line = np.stack([cylinder.start, cylinder.axis])
    view, side, position, columns = _contour_lines(
        line,
        cylinder.length,
        cylinder.radius,
        arrays.poses,
        arrays.lenses,
        arrays.sizes,
        arrays.centres,
        basis,
        fractions,
        margin,
    )
    share, gain = fractions[position], columns[:, 4]
    jacobian = np.empty((len(view), 5))
    jacobian[:, 0:2] = (gain * (1.0 - share))[:, None] * columns[:, 5:7]
    jacobian[:, 2:4] = (gain * share)[:, None] * columns[:, 5:7]
    jacobian[:, 4] = gain
    along = (share - 0.5) * cylinder.length
    pixel, normal = np.ascontiguousarray(columns[:, 0:2]), np.ascontiguousarray(columns[:, 2:4])
    half_width, depth = gain * cylinder.radius, np.ascontiguousarray(columns[:, 7])
    samples = ContourSamples(view, side, pixel, normal, along, gain, half_width, depth, jacobian)
    if all(each.rolled is None for each in views):
        return samples
    return samples.select(_within_images(samples, views, margin))


def _within_images(samples: ContourSamples, views: Sequence[View], margin: float) -> NDArray[np.bool_]:
    """Mask (N,) of the samples that rolling shutters show farther than `margin` [px] inside the images."""
    result = np.ones(len(samples), bool)
    for index, part in parts_by_view(samples, len(views)):
        view = views[index]
        shown = view.shown(samples.pixel[part], samples.depth[part])
        size = np.array([view.camera.width, view.camera.height])
        result[part] = ((shown > margin) & (shown < size - 1 - margin)).all(axis=1)
    return result


@njit(cache=True, nogil=True)
def _contour_lines(
    line: FloatArray,
    length: float,
    radius: float,
    poses: FloatArray,
    lenses: FloatArray,
    sizes: FloatArray,
    centres: FloatArray,
    basis: FloatArray,
    fractions: FloatArray,
    margin: float,
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """View, side and position (N,) of the samples that lie within an image, and their columns (N, 8).

    These are: pixel (2), outward normal (2), gain, the displacement of the surface along the outward normal by a step
    along the basis (2), and depth. The gain is exact: displacing the surface by d along its outward normal at the
    contact generator moves the line by d / (depth |l|) pixels, l being the image line of the tangent plane (envelope
    theorem).

    Args:
        line: start and unit direction (2, 3) of the axis.
        length: of the cylinder [m].
        radius: of the cylinder [m].
        poses: camera_from_map (V, 3, 4).
        lenses: fx, fy, cx, cy (V, 4).
        sizes: of the images (V, 2).
        centres: projection centres (V, 3).
        basis: (2, 3), see `contour_samples`.
        fractions: of the length (B,).
        margin: see `contour_samples`.
    """
    most = 2 * len(poses) * len(fractions)
    indices = np.empty((3, most), np.int64)
    columns = np.empty((most, 8))
    count = 0
    start, axis = np.ascontiguousarray(line[0]), np.ascontiguousarray(line[1])
    for v in range(len(poses)):
        rotation, shift = np.ascontiguousarray(poses[v, :, :3]), poses[v, :, 3]
        fx, fy, cx, cy = lenses[v]
        offset = start - centres[v]
        offset = offset - axis * (axis * offset).sum()
        distance = np.sqrt((offset * offset).sum())
        if distance <= radius * (1.0 + 1e-9):  # within the cylinder
            continue
        towards = offset / distance
        across = np.cross(axis, towards)
        sine = radius / distance
        for side in range(2):
            sign = 1.0 - 2.0 * side
            normal = sine * towards + sign * np.sqrt(1.0 - sine * sine) * across
            turned = rotation @ normal
            u, w = turned[0] / fx, turned[1] / fy
            slope = np.hypot(u, w)
            if slope < 1e-12:
                continue
            first = rotation @ (start - radius * normal) + shift
            along = length * (rotation @ axis)
            for b in range(len(fractions)):
                x, y, depth = first + fractions[b] * along
                if depth <= NEAR_PLANE:
                    continue
                px, py = fx * x / depth + cx, fy * y / depth + cy
                if not (margin < px < sizes[v, 0] - 1 - margin and margin < py < sizes[v, 1] - 1 - margin):
                    continue
                indices[:, count] = v, side, b
                columns[count, 0:2] = px, py
                columns[count, 2:4] = -u / slope, -w / slope
                columns[count, 4] = 1.0 / (depth * slope)
                for k in range(2):
                    columns[count, 5 + k] = -(basis[k] * normal).sum()
                columns[count, 7] = depth
                count += 1
    return indices[0, :count].copy(), indices[1, :count].copy(), indices[2, :count].copy(), columns[:count].copy()
