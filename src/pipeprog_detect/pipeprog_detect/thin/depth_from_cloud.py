# SPDX-License-Identifier: Apache-2.0
"""A thin pipe as it looks from where it is seen: its direction in the image is known well, its depth is the cloud's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.silhouette.apparent_contour import ViewArrays
from pipeprog_detect.thin.percentiles import by_bin
from pipeprog_detect.types import Cylinder, View

# Width of the strip of cloud beside a thin pipe that it is compared with, in its own widths.
BESIDE_REACH = 4.0
# Strip of cloud beside a thin pipe in which a face that it is the edge of must go on: beyond what half a stereo window
# spreads of the pipe itself, in radii. And strips between that and its edge, which a face fills as well: between two
# pipes there is a gap.
FACE, UP_TO_FACE = (4.0, 8.0), ((2.0, 3.0), (3.0, 4.0))
# Share of its length along which the cloud must show what is there and beside it, to tell whether a line is an edge:
# more than clamps and crossing pipes take.
SHOWN = 0.2
# Distance before and behind a proposed axis in which the cloud counts [m].
DEPTH_REACH = 0.3
# Largest gap [m] between pieces of one pipe: what crosses before it hides it so far.
GAP = 0.3
# Along the lines of sight to a thin pipe the cloud shows more of the wall than of it: this percentile of the depths is
# still its own.
FRONT = 10.0
# Stereo draws a thin pipe to the wall, never to the camera: the nearest quarter of the positions tells its depth.
FOREMOST = 0.25


def mean_centre(cylinder: Cylinder, views: Sequence[View]) -> FloatArray | None:
    """Mean projection centre (3,) of the views that show the cylinder's middle, None where none does."""
    if not views:
        return None
    arrays = ViewArrays.of(views)
    centres = arrays.centres[arrays.showing(cylinder.middle[None])]
    return np.asarray(centres.mean(axis=0), np.float64) if len(centres) else None


def covers(one: Cylinder, other: Cylinder, centre: FloatArray, radii: float, common: float = -GAP) -> bool:
    """Whether two cylinders look, from `centre`, like pieces of one: their depths are what is known worst.

    Their lines of sight may pass each other at up to `radii` radii of the first. They have more than the length
    `common` [m] in common, at the distance of the first; a negative one is a gap between them.
    """
    axis, towards, side = _sight(one, centre)
    ends = np.stack([other.start, other.end]) - centre
    depth = float((one.start - centre) @ towards)
    place = (ends @ axis) * depth / (ends @ towards) - float((one.start - centre) @ axis)
    aside = (ends @ side) * depth / (ends @ towards)
    low, high = float(place.min()), float(place.max())
    in_front = float((ends @ towards).min()) > 0.5 * depth
    longer = min(high, one.length) - max(low, 0.0) > common
    return in_front and longer and float(np.abs(aside).max()) < radii * one.radius


def extended_to(one: Cylinder, other: Cylinder, centre: FloatArray) -> Cylinder:
    """The first cylinder made as long as both, seen from `centre`."""
    axis, towards, _ = _sight(one, centre)
    ends = np.stack([other.start, other.end]) - centre
    depth = float((one.start - centre) @ towards)
    place = (ends @ axis) * depth / (ends @ towards) - float((one.start - centre) @ axis)
    low, high = min(float(place.min()), 0.0), max(float(place.max()), one.length)
    return Cylinder(one.start + low * axis, one.start + high * axis, one.radius)


def at_cloud_depth(
    cylinder: Cylinder, points: NDArray[np.float32], centre: FloatArray, sloping: bool = True
) -> Cylinder | None:
    """The cylinder at the depth of the nearest points (N, 3) that it hides from `centre`; None where there are few.

    Where these lie no nearer than those beside it they are the wall's: the cloud does not show the pipe there. Unless
    it is `sloping` it keeps its direction.
    """
    towards = _sight(cylinder, centre)[1]
    depth = float((cylinder.start - centre) @ towards)
    bins, cell, aside, far, _ = _beside(cylinder, points, centre)
    inner = np.abs(aside) < 0.6 * cylinder.radius
    front = by_bin(cell[inner], far[inner], bins, FRONT)
    flanks = []
    for sign in (-1.0, 1.0):
        beside = (sign * aside > 2.4 * cylinder.radius) & (sign * aside < 2.0 * BESIDE_REACH * cylinder.radius)
        flanks.append(by_bin(cell[beside], far[beside], bins, FRONT))
    known = np.isfinite(front) & ~(np.fmax(*flanks) - front < cylinder.radius)
    if known.sum() < 0.3 * bins:
        return None
    at, inverse_front = (np.arange(bins)[known] + 0.5) / bins, 1.0 / front[known]
    if sloping:
        slope, level = robust_line(at, inverse_front)
    else:
        slope = float(1.0 / ((cylinder.end - centre) @ towards) - 1.0 / depth)
        level = float(np.quantile(inverse_front - slope * at, 1.0 - FOREMOST))
    inverse = np.array([level, level + slope])
    if (np.abs(depth * inverse - 1.0) > DEPTH_REACH * inverse).any():
        return None
    ends = []
    for end, share in ((cylinder.start, 0.0), (cylinder.end, 1.0)):
        ray = end - centre
        ends.append(centre + ray * (1.0 / (level + share * slope) + 0.5 * cylinder.radius) / float(ray @ towards))
    return Cylinder(ends[0], ends[1], cylinder.radius)


def is_edge_of_face(
    cylinder: Cylinder,
    points: NDArray[np.float32],
    views: Sequence[View],
    walls: Sequence[Plane],
    others: Sequence[Cylinder],
) -> bool:
    """Whether a face whose edge it is goes on beside it: a tray's, a duct's or a board's.

    Seen from the mean centre of the views, the cloud's points (N, 3) then lie as far away beside it, on one side and
    without a gap, as where it is, and on the other side farther away by its diameter at least. What the cloud shows
    there may be nearer than it, since lines tell the depth of an edge badly, but not behind it. One of the `walls`,
    seen aslant, is farther away on one side as well; it has no edge where it goes on. The barrels of the `others` are
    no faces.
    """
    centre = mean_centre(cylinder, views)
    if centre is None:
        return False
    depth, radius = float((cylinder.start - centre) @ _sight(cylinder, centre)[1]), cylinder.radius
    bins, cell, aside, far, rows = _beside(cylinder, points, centre)
    own = np.flatnonzero(np.abs(aside) < FACE[1] * radius)
    own = own[~_are_on(others, points[rows[own]], radius)]
    cell, aside, far, rows = cell[own], aside[own], far[own], rows[own]

    def level(strip: tuple[float, float], side: float, values: NDArray[np.floating] = far) -> FloatArray:
        there = (side * aside > strip[0] * radius) & (side * aside < strip[1] * radius)
        return by_bin(cell[there], values[there], bins, 50.0)

    on = level((-0.6, 0.6), 1.0)
    beside = {side: level(FACE, side) for side in (-1.0, 1.0)}
    shown = on - depth < 2.0 * radius
    for wall in walls:
        off = np.abs(points[rows] @ wall.normal.astype(np.float32) - np.float32(wall.offset))
        shown &= ~np.all([level(FACE, side, off) < radius for side in beside], axis=0)
    for side, face in beside.items():
        told = shown & np.isfinite(face)
        if told.sum() > SHOWN * bins:
            strips = [face, *(level(strip, side) for strip in UP_TO_FACE)]
            flush = np.all([np.abs(strip - on) < 2.0 * radius for strip in strips], axis=0)
            farther = ~(beside[-side] - on < 2.0 * radius)
            if (told & flush & farther).sum() > 0.5 * told.sum():
                return True
    return False


def _are_on(cylinders: Sequence[Cylinder], points: NDArray[np.float32], clearance: float) -> NDArray[np.bool_]:
    """Which of the points (N, 3) lie within a cylinder, or no more than `clearance` [m] beside its surface."""
    on = np.zeros(len(points), bool)
    for each in cylinders:
        low = np.minimum(each.start, each.end) - each.radius - clearance
        high = np.maximum(each.start, each.end) + each.radius + clearance
        near = np.flatnonzero(((points > low) & (points < high)).all(axis=1) & ~on)
        along = each.along(points[near])
        on[near] = (along > 0.0) & (along < each.length) & (each.surface_distance(points[near]) < clearance)
    return on


def _beside(
    cylinder: Cylinder, points: NDArray[np.float32], centre: FloatArray
) -> tuple[int, NDArray[np.int64], FloatArray, FloatArray, NDArray[np.int64]]:
    """The cloud's points (N, 3) that `centre` sees along a cylinder, no farther from its depth than `DEPTH_REACH`.

    Number of bins along it; bin (M,), distance from the axis in the image, at its depth (M,) [m], depth (M,) [m], and
    row among the points (M,).
    """
    bins = max(int(cylinder.length / (4.0 * cylinder.radius)), 3)
    rows, place, aside, far = seen_along(cylinder, points, centre, (-DEPTH_REACH, DEPTH_REACH))
    cell = np.clip((place / cylinder.length * bins).astype(np.int64), 0, bins - 1)
    return bins, cell, aside, far, rows


def seen_along(
    cylinder: Cylinder, points: NDArray[np.float32], centre: FloatArray, reach: tuple[float, float]
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """The cloud's points (N, 3) that `centre` sees along a cylinder, between `reach` [m] behind it (less: before it).

    Row among the points (M,), position along the cylinder and distance from its axis in the image, both at its depth,
    and depth (M,) [m].
    """
    sight, start = np.stack(_sight(cylinder, centre)), cylinder.start - centre
    return _seen_along(points, centre, sight, start, cylinder.length, reach)


@njit(cache=True, nogil=True)
def _seen_along(
    points: NDArray[np.float32],
    centre: FloatArray,
    sight: FloatArray,
    start: FloatArray,
    length: float,
    reach: tuple[float, float],
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """See `seen_along`; `sight` (3, 3): what `_sight` gives, `start` (3,): the cylinder's, from `centre` on [m]."""
    axis, towards, side = sight
    depth, first = (start * towards).sum(), (start * axis).sum()
    row = np.empty(len(points), np.int64)
    seen = np.empty((3, len(points)))
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        far = x * towards[0] + y * towards[1] + z * towards[2]
        if not (far > 0.0 and reach[0] < far - depth < reach[1]):
            continue
        place = (x * axis[0] + y * axis[1] + z * axis[2]) * depth / far - first
        if 0.0 < place < length:
            aside = (x * side[0] + y * side[1] + z * side[2]) * depth / far
            row[count], seen[0, count], seen[1, count], seen[2, count] = i, place, aside, far
            count += 1
    return row[:count].copy(), seen[0, :count].copy(), seen[1, :count].copy(), seen[2, :count].copy()


def robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope and value at 0 of the line through points (N,), by the median of the slopes of all pairs (Theil, Sen)."""
    if len(x) < 2:
        return 0.0, float(y[0])
    # scipy.stats.theilslopes gives the same, but scipy.stats takes half a second to import, in each process.
    x, y = x.astype(float), y.astype(float)
    run, rise = np.subtract.outer(x, x), np.subtract.outer(y, y)
    slope = float(np.median(rise[run > 0] / run[run > 0]))
    return slope, float(np.median(y - slope * x))


def _sight(cylinder: Cylinder, centre: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors (3,) along the axis, from `centre` straight to it, and across both."""
    axis = cylinder.axis
    towards = cylinder.start - centre
    towards = towards - axis * (axis @ towards)
    towards = np.asarray(towards / np.linalg.norm(towards), np.float64)
    side: FloatArray = np.cross(axis, towards).astype(np.float64)
    return axis, towards, side
