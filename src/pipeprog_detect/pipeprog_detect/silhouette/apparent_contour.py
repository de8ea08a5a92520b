# SPDX-License-Identifier: Apache-2.0
"""The apparent contour of a circular cylinder: its two image lines in a view, and how they move with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
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
    jacobian: FloatArray

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: NDArray[np.bool_] | IntArray) -> ContourSamples:
        """Those that a mask or an index array names."""
        return ContourSamples(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def thinned(self, limit: int) -> ContourSamples:
        """About `limit` of them (fewer than twice as many), evenly spread."""
        return self.select(np.arange(0, len(self), max(len(self) // limit, 1)))

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


def tangent_normals(cylinder: Cylinder, centre: FloatArray) -> FloatArray | None:
    """Unit normals (2, 3) of the planes through `centre` that touch the cylinder; None where it lies inside.

    Both point inwards: the axis lies at distance `radius` on their positive side. The tangent-plane form of the
    apparent contour of a straight homogeneous generalised cylinder.
    """
    axis, radius = cylinder.axis, cylinder.radius
    offset = cylinder.start - centre
    offset = offset - axis * (axis @ offset)
    distance = float(np.linalg.norm(offset))
    if distance <= radius * (1.0 + 1e-9):
        return None
    towards = offset / distance
    across = np.cross(axis, towards)
    sine = radius / distance
    cosine = np.sqrt(1.0 - sine * sine)
    return np.stack([sine * towards + cosine * across, sine * towards - cosine * across])


def project(view: View, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and depths (N,) [m] of points (N, 3) of the map."""
    in_camera = points @ view.camera_from_map[:3, :3].T + view.camera_from_map[:3, 3]
    depth = in_camera[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    camera = view.camera
    pixel = np.stack(
        [camera.fx * in_camera[:, 0] / safe + camera.cx, camera.fy * in_camera[:, 1] / safe + camera.cy], axis=1
    )
    return pixel, depth


def in_image(view: View, points: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of the points (N, 3) of the map that lie before the camera and within the image."""
    pixel, depth = project(view, points)
    size = np.array([view.camera.width, view.camera.height])
    return np.asarray((depth > NEAR_PLANE) & (pixel > 0).all(axis=1) & (pixel < size - 1).all(axis=1))


def views_showing(points: FloatArray, views: Sequence[View], most: int) -> list[View]:
    """The views that show some of the points (N, 3) of the map, evenly thinned to `most` at the most."""
    able = [view for view in views if in_image(view, points).any()]
    return able[:: -(-len(able) // most)] if able else []


def contour_samples(
    cylinder: Cylinder, views: Sequence[View], basis: FloatArray, spacing: float, margin: float = 4.0
) -> ContourSamples:
    """Samples farther than `margin` [px] inside the images, about `spacing` [px] apart in the median view.

    The positions along the axis are common to all views, so that evidence can be pooled by position. `basis` (2, 3):
    the directions across the axis of which the Jacobian is taken.
    """
    gains = [view.camera.fx / max(float(np.linalg.norm(view.centre - cylinder.middle)), 1e-3) for view in views]
    step = spacing / float(np.median(gains))
    count = max(int(cylinder.length / step), 4)
    fractions = (np.arange(count) + 0.5) / count
    parts: list[tuple[NDArray[np.generic], ...]] = []
    for index, view in enumerate(views):
        for side, columns in _sides(cylinder, view, basis, fractions, margin):
            total = len(columns[0])
            parts.append((np.full(total, index), np.full(total, side), *columns))
    if not parts:
        empty = np.zeros(0)
        none = np.zeros(0, int)
        return ContourSamples(none, none, np.zeros((0, 2)), np.zeros((0, 2)), empty, empty, empty, np.zeros((0, 5)))
    return ContourSamples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _sides(
    cylinder: Cylinder, view: View, basis: FloatArray, fractions: FloatArray, margin: float
) -> Iterator[tuple[int, tuple[FloatArray, ...]]]:
    """The sides that a view shows, each with the columns of `ContourSamples` from `pixel` on.

    The Jacobian is exact: displacing the surface by d along its outward normal at the contact generator moves the
    line by d / (depth |l|) pixels, l being the image line of the tangent plane (envelope theorem).
    """
    normals = tangent_normals(cylinder, view.centre)
    if normals is None:
        return
    length = cylinder.length
    rotation = view.camera_from_map[:3, :3]
    inverse = np.linalg.inv(view.camera.matrix)
    on_axis = cylinder.start + fractions[:, None] * (length * cylinder.axis)
    size = np.array([view.camera.width, view.camera.height])
    for side, normal in enumerate(normals):
        line = inverse.T @ (rotation @ normal)
        slope = float(np.hypot(line[0], line[1]))
        pixel, depth = project(view, on_axis - cylinder.radius * normal)
        within = (depth > NEAR_PLANE) & (pixel > margin).all(axis=1) & (pixel < size - 1 - margin).all(axis=1)
        if not within.any() or slope < 1e-12:
            continue
        gain = 1.0 / (depth[within] * slope)
        share = fractions[within]
        sideways = -(basis @ normal)
        moves = [(1.0 - share)[:, None] * sideways, share[:, None] * sideways, np.ones((len(share), 1))]
        jacobian = gain[:, None] * np.concatenate(moves, axis=1)
        outward = np.broadcast_to(-line[:2] / slope, (len(share), 2))
        yield side, (pixel[within], outward, (share - 0.5) * length, gain, gain * cylinder.radius, jacobian)
