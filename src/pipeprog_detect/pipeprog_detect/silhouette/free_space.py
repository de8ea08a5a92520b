# SPDX-License-Identifier: Apache-2.0
"""Where the keyframes see through a cylinder: what they show behind it proves that no pipe is there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import ViewArrays, in_image, project
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.occlusion import BEFORE, STEREO_WINDOW, cylinder_rows, hidden_by_cylinders
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.silhouette.surface_texture import face_log_odds
from pipeprog_detect.types import Cylinder, View

# Distance [m] between the positions looked at: less than a cell of a view's depths (8 px: 16 mm at 2 m with 1000 px).
STEP = 0.01
# A stretch is free where at least three views, two and more at each position, and more than half of those that look at
# it, see what is behind it: stereo is wrong in one view, not in three from different places.
MIN_VIEWS, MIN_AT_ONCE, MIN_SHARE = 3, 2, 0.5
# What is seen lies behind where it is farther from the axis than the inside of an open end, one radius, and a fifth.
BEHIND_RADII = 1.2
# What stands out from where the barrel would be by more than this [m] is before it: stereo spreads edges by a
# centimetre.
STANDING_OUT = 0.015
# Beside the axis they are looked at here, in radii: as far from it as a cell of a view's depths allows, which must lie
# within the limb. The barrel is three quarters of the radius before its axis there; what lies behind the axis by half
# of the radius is none of it.
BESIDE, BEHIND_LIMB = 0.65, 0.5
# What shines through a hole in the cloud of something that is not smooth, such as a flange, is not seen on both sides
# of the axis as well: there it is looked at here, in radii.
ASIDE = 0.5
# A stretch whose contour is seen is no gap. It is looked at this often [px].
SPACING = 6
# Logarithm of the odds from which a contour is decisively none (Jeffreys: a hundred to one).
REFUTED = float(np.log(100.0))
# A known part without holes tells that a stretch is none where it is this many times as long: after k times its length
# without one the next is a hole with a probability of 1 / (k + 2) (Laplace's rule of succession), one in four.
DENSE = 2.0
# Free stretches shorter than this [m] are left out: two cells of a view's depths.
SHORTEST = 0.03


def free_stretches(
    cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder], known: Cylinder | None = None
) -> list[tuple[float, float]]:
    """Stretches (from, to) [m from the start] of the axis at which most views see a surface that lies behind it.

    Where its contour is seen, or the texture of its face, a stretch is a hole in the cloud of the pipe's face. It may
    be one where nothing of the contour is seen: what hides it misleads stereo beside it. But beyond a `known` part that
    is much longer, and through less of which the views see, a contour is that of something in line with the pipe, and
    where none is seen the pipe has ended.

    Args:
        cylinder: whose axis is looked at, and whose contour decides where stereo has holes.
        views: the keyframes, with the depths of the nearest surfaces (`with_depths`).
        others: further cylinders, which may hide it.
        known: the pipe beyond whose end the cylinder lies.
    """
    stretches = _seen_through(cylinder, views, others)
    supports = [Scene.of(cylinder.cut(*each), views, others).support(spacing=SPACING) for each in stretches]
    if known is None:
        return [
            each
            for each, one in zip(stretches, supports, strict=True)
            if one.share < MIN_SUPPORT
            and one.log_odds().sum() < -REFUTED
            and face_log_odds(cylinder.cut(*each), views, others) < REFUTED
        ]
    holes = _holes(known, views, others) if stretches else 0.0
    return [
        (first, last)
        for (first, last), one in zip(stretches, supports, strict=True)
        if one.share < MIN_SUPPORT or holes < last - first < known.length / DENSE
    ]


def is_empty_beside(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> bool:
    """Whether the views see through a cylinder between its axis and one limb, and not at the other.

    Then one of its limbs is the edge of another thing: of a shadow on the wall behind a thinner pipe, or of a tray.
    For the arguments see `free_stretches`.
    """
    count = max(int(np.ceil(cylinder.length / STEP)), 2)
    axis = cylinder.at((np.arange(count) + 0.5) / count)
    rows, room = cylinder_rows(others), 2.0 * (1.0 - BESIDE) * cylinder.radius
    reach = max(BEFORE, BEHIND_LIMB * cylinder.radius)
    through, on_it, seeing = np.zeros(2), np.zeros(2), np.zeros(2)
    for index in np.flatnonzero(ViewArrays.of(views).showing(axis)) if views else ():
        view = views[index]
        across = BESIDE * cylinder.radius * _across(cylinder, axis, view)
        for side, points in enumerate((axis - across, axis + across)):
            _, depth, nearest = _seen_at(points, room, view, rows)
            behind = nearest > depth + reach
            through[side] += behind.sum()
            on_it[side] += (~behind & (nearest > depth - cylinder.radius - BEFORE)).sum()
            seeing[side] += behind.any()
    empty = (through > MIN_SHARE * (through + on_it)) & (seeing >= MIN_VIEWS)
    return bool(empty.any() and not empty.all())


def _holes(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> float:
    """Length [m] of a pipe that the views see through."""
    return sum(last - first for first, last in _seen_through(cylinder, views, others))


def _seen_through(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> list[tuple[float, float]]:
    """Stretches (from, to) [m from the start] of the axis behind which most views see a surface."""
    count = max(int(np.ceil(cylinder.length / STEP)), 2)
    along = (np.arange(count) + 0.5) * cylinder.length / count
    points = cylinder.start + along[:, None] * cylinder.axis
    rows = cylinder_rows(others)
    behind: NDArray[np.bool_] = np.zeros((0, count), bool)
    before: FloatArray = np.zeros(count)
    for index in np.flatnonzero(ViewArrays.of(views).showing(points)) if views else ():
        through, opaque = _looked_through(points, cylinder, views[index], rows)
        behind, before = np.vstack([behind, through]), before + opaque
    seen = behind.sum(axis=0)
    free = (seen >= MIN_AT_ONCE) & (seen > MIN_SHARE * (seen + before))
    edges = np.flatnonzero(np.diff(np.r_[False, free, False].astype(np.int8))).reshape(-1, 2)
    step = cylinder.length / count
    return [
        (float(first * step), float(last * step))
        for first, last in edges
        if (last - first) * step > SHORTEST and behind[:, first:last].any(axis=1).sum() >= MIN_VIEWS
    ]


def _looked_through(
    points: FloatArray, cylinder: Cylinder, view: View, others: FloatArray
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks (N,) of the points (N, 3) of the axis behind which the view sees a surface, and at which it sees one.

    A view tells where the cell of its depths would lie within the silhouette of the pipe: of thinner ones stereo shows
    the wall behind them. What is nearer than the pipe's barrel would be hides the point.
    """
    through, opaque = np.zeros(len(points), bool), np.zeros(len(points), bool)
    looked, behind, on_it = _compared(points, cylinder.radius, view, others)
    through[looked], opaque[looked] = behind, on_it
    across = _across(cylinder, points, view)
    for aside in (-ASIDE * cylinder.radius * across, ASIDE * cylinder.radius * across):
        seen = np.flatnonzero(through)
        looked, behind, on_it = _compared(points[seen] + aside[seen], cylinder.radius, view, others)
        through[seen[looked]], opaque[seen[looked]] = behind, on_it
    return through, opaque


def _compared(
    points: FloatArray, radius: float, view: View, others: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Rows (M,) of the points (N, 3) where a view tells, and masks (M,): it sees what is behind them, or the pipe."""
    looked, depth, nearest = _seen_at(points, radius, view, others)
    behind = depth + max(BEFORE, BEHIND_RADII * radius)
    return looked, nearest > behind, (nearest <= behind) & (nearest > depth - radius - STANDING_OUT)


def _across(cylinder: Cylinder, points: FloatArray, view: View) -> FloatArray:
    """Unit vectors (N, 3) across the axis and the lines of sight to points (N, 3) on it."""
    across = np.cross(cylinder.axis, points - view.centre)
    return np.asarray(across / np.linalg.norm(across, axis=1)[:, None], np.float64)


def _seen_at(
    points: FloatArray, room: float, view: View, others: FloatArray
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.float32]]:
    """Of the points (N, 3) those where a view has a depth: row (M,), their depth and that of what is seen (M,) [m].

    The cell of its depths must be smaller than `room` [m] there, and none of the `others` hide the point.
    """
    if view.nearest is None:
        return np.empty(0, np.int64), np.empty(0), np.empty(0, np.float32)
    cell = view.camera.width / view.nearest.shape[1]
    # Nearer to its edge an image gives stereo no window: what the cloud shows there is what other views have seen.
    looked = np.flatnonzero(in_image(view, points, STEREO_WINDOW))
    pixel, depth = project(view, points[looked])
    told = (view.camera.fx * room > cell * depth) & ~hidden_by_cylinders(view, pixel, depth, others)
    looked, pixel, depth = looked[told], pixel[told], depth[told]
    row = np.clip((pixel[:, 1] / cell).astype(np.int64), 0, view.nearest.shape[0] - 1)
    column = np.clip((pixel[:, 0] / cell).astype(np.int64), 0, view.nearest.shape[1] - 1)
    nearest = view.nearest[row, column]
    known = np.isfinite(nearest)
    return looked[known], depth[known], nearest[known]
