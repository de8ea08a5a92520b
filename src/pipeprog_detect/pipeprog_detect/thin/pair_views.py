# SPDX-License-Identifier: Apache-2.0
"""The segment pairs of all keyframes that are far enough apart, with the depths that the cloud gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import NEAR_PLANE, contour_samples
from pipeprog_detect.silhouette.occlusion import cylinder_rows, depth_of_cylinders
from pipeprog_detect.thin.depth_from_cloud import BESIDE_REACH, robust_line
from pipeprog_detect.thin.line_segments import SegmentPairs, segment_pairs, straight_edges
from pipeprog_detect.thin.percentiles import by_bin
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View

# Baseline from view to view, as a share of the median depth of what they see, and number of views at the most.
STEP, MOST_VIEWS = 0.12, 120
# Half of a thin pipe's width [px] that suffices to see its two sides: larger images are reduced.
ENOUGH = 4.5
# Points of the cloud in a view that tell what it sees, and so many that more of them move a percentile by less than the
# range of depths that is added.
LEAST_POINTS, ENOUGH_POINTS = 100, 5000
# Standard deviations of a segment pair's centre line and width [px], shading and shadows beside the pipe included.
CENTRE_SIGMA, WIDTH_SIGMA = 1.0, 1.2
# A segment lies on an outline within two standard deviations of its place [px]. Spacing [px] of the outline's samples:
# it is straight.
ON_OUTLINE, OUTLINE_SPACING = 2.0, 40.0


@dataclass(frozen=True)
class PairView:
    """One view at the size at which lines were sought, its segment pairs, and the depths [m] of what it sees.

    Attributes:
        view: the view.
        pairs: its N segment pairs.
        depth: least and largest depth [m].
        before: depth (N, 2) [m] of the cloud at the pairs' ends, NaN where the cloud does not show them.
    """

    view: View
    pairs: SegmentPairs
    depth: tuple[float, float]
    before: FloatArray


def pair_views(
    views: Sequence[View],
    points: NDArray[np.float32],
    radii: Sequence[float],
    known: Sequence[Cylinder],
    edges: dict[tuple[int, int, bool], FloatArray],
) -> list[PairView]:
    """Those of the views that tell more than the one before, each with the segment pairs that may be thin pipes.

    Args:
        views: the keyframes.
        points: of the cloud (N, 3); they bound the depths of each view.
        radii: of thin pipes [m].
        known: pipes: between their outlines and before them no segment pairs are sought, since their highlights,
            shadows and seams look like thin pipes.
        edges: straight edges that earlier calls found, by stamp, width and whether in colour; new ones are added.
    """
    seen = mapped(lambda view: _pair_view(view, points, radii, known, edges), apart(views, points))
    return [each for each in seen if each is not None]


def seek_edges(
    view: View, points: NDArray[np.float32], radii: Sequence[float], edges: dict[tuple[int, int, bool], FloatArray]
) -> None:
    """Adds a view's straight edges to those found, for `pair_views` with these points and radii."""
    sized = _sized(view, points, radii)
    if sized is not None:
        _edges_of(sized[0], view.is_in_colour, edges)


def _edges_of(sized: View, is_in_colour: bool, edges: dict[tuple[int, int, bool], FloatArray]) -> FloatArray:
    """Straight edges of a view at the size at which they are sought, those found before where there are any."""
    key = (sized.stamp, sized.camera.width, is_in_colour)
    if key not in edges:
        edges[key] = straight_edges(sized.image)
    return edges[key]


def apart(views: Sequence[View], points: NDArray[np.float32]) -> list[View]:
    """Views of the cloud's points far enough from the last one to tell more than it did."""
    chosen: list[View] = []
    sparse = points[:: max(len(points) // ENOUGH_POINTS, 1)]
    for view in views:
        depth = _points_in(view, sparse)[1]
        if len(depth) and (
            not chosen or np.linalg.norm(view.centre - chosen[-1].centre) > STEP * float(np.median(depth))
        ):
            chosen.append(view)
    return chosen[:: -(-len(chosen) // MOST_VIEWS)] if chosen else []


def distinct_views(views: Sequence[View], points: NDArray[np.float32], radii: Sequence[float]) -> list[View]:
    """Those of the views that tell more than the one before, as small as thin pipes of these radii [m] allow."""
    sized = (_sized(view, points, radii) for view in apart(views, points))
    return [each[0] for each in sized if each is not None]


def _sized(
    view: View, points: NDArray[np.float32], radii: Sequence[float]
) -> tuple[View, NDArray[np.float32], NDArray[np.float32]] | None:
    """The view, reduced to what suffices, and pixels (M, 2) and depths (M,) [m] of points in it; None with too few."""
    pixel, depth = _points_in(view, points)
    if len(depth) < LEAST_POINTS:
        return None
    middle = np.median(depth[:: max(len(depth) // ENOUGH_POINTS, 1)])
    scale = min(1.0, ENOUGH * middle / (min(radii) * view.camera.fx))
    scale = 2.0 ** (round(4.0 * np.log2(scale)) / 4.0)  # few sizes, so that edges found before serve again
    if scale < 1.0:
        width, height = (max(round(scale * side), 1) for side in (view.camera.width, view.camera.height))
        image = np.asarray(cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        rolled = None if view.rolled is None else view.rolled.scaled(scale)
        view = replace(view, image=image, camera=view.camera.scaled(scale), rolled=rolled)
        pixel = (pixel + 0.5) * scale - 0.5
    return view, pixel, depth


def _pair_view(
    view: View,
    points: NDArray[np.float32],
    radii: Sequence[float],
    known: Sequence[Cylinder],
    edges: dict[tuple[int, int, bool], FloatArray],
) -> PairView | None:
    sized = _sized(view, points, radii)
    if sized is None:
        return None
    is_in_colour = view.is_in_colour
    view, pixel, depth = sized
    near, middle, far = np.percentile(depth[:: max(len(depth) // ENOUGH_POINTS, 1)], [1, 50, 99])
    focal = view.camera.fx
    narrowest, widest = 2.0 * focal * min(radii) / far - WIDTH_SIGMA, 2.0 * focal * max(radii) / near + WIDTH_SIGMA
    lines = _edges_of(view, is_in_colour, edges)
    found = segment_pairs(_at_the_stamp(lines, view, float(middle)), max(narrowest, 2.0), widest)
    found = found.select(~between_outlines(found, known, view))
    behind = depth_of_cylinders(view, found.ends.reshape(-1, 2), cylinder_rows(known)).reshape(-1, 2)
    found = found.select(np.any(np.isinf(behind), axis=1))
    before, flat = _cloud_depths(found, pixel, depth, min(radii))
    return PairView(view, found.select(~flat), (0.9 * float(near), 1.1 * float(far)), before[~flat])


def _at_the_stamp(edges: FloatArray, view: View, middle: float) -> FloatArray:
    """Where straight edges (N, 2, 2) [px] of the image lie at the stamp, by the cloud's depths at their ends.

    Where the cloud shows nothing the depth is `middle` [m].
    """
    if view.rolled is None or not len(edges):
        return edges
    ends = edges.reshape(-1, 2)
    depth: FloatArray = np.full(len(ends), middle)
    if view.nearest is not None:
        rows, columns = view.nearest.shape
        cell = np.floor(ends * (columns / view.camera.width)).astype(np.int64)
        there = view.nearest[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)]
        depth = np.where(np.isfinite(there), there, middle).astype(float)
    return view.rolled.motion.unrolled_pixels(ends, depth, view.rolled.camera).reshape(-1, 2, 2)


def _cloud_depths(
    found: SegmentPairs, pixel: NDArray[np.float32], depth: NDArray[np.float32], radius: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Depth [m] of the cloud at the ends (N, 2) of segment pairs that stand out from it, and which lie flat in it (N,).

    A pipe that touches a wall stands out from it by its diameter, a painted strip, a joint or a shadow does not.
    Stereo spreads a thin pipe in depth, towards the wall: of the points within a segment pair the nearer count. Where a
    segment pair holds too few, depth is NaN.
    """
    before = np.full((len(found), 2), np.nan)
    flat = np.zeros(len(found), bool)
    for number in range(len(found)):
        ends, width = found.ends[number], float(found.width[number].mean())
        reach = BESIDE_REACH * width
        length = float(np.linalg.norm(ends[1] - ends[0]))
        place, aside, there = _along(pixel, depth, ends, length, reach)
        bins = max(int(length / max(width, 6.0)), 3)
        cell = np.minimum((place / length * bins).astype(np.int64), bins - 1)
        inner = np.abs(aside) < 0.35 * width
        front = by_bin(cell[inner], there[inner], bins, 30.0)
        flanks = []
        for side in (-1.0, 1.0):
            beside = side * aside > 1.2 * width
            flanks.append(by_bin(cell[beside], there[beside], bins, 50.0))
        known = np.isfinite(front)
        if known.sum() < 0.5 * bins:
            continue
        behind = np.fmax(*flanks)
        step = behind - front
        judged = np.isfinite(step)
        flat[number] = judged.sum() >= 0.5 * bins and np.median(step[judged]) < radius
        if flat[number]:
            continue
        # Inverse depth is linear along the image of a line.
        at = (np.arange(bins) + 0.5) / bins
        slope, level = robust_line(at[known], 1.0 / front[known])
        if level > 0 and level + slope > 0:
            before[number] = 1.0 / level, 1.0 / (level + slope)
    return before, flat


def _points_in(view: View, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (M, 2) and depths (M,) [m] of those points (N, 3) that lie within the view."""
    camera = view.camera
    matrix = (camera.matrix @ view.camera_from_map[:3]).astype(np.float32)
    return _projected_points(points, matrix, camera.width, camera.height)


@njit(cache=True, nogil=True)
def _projected_points(
    points: NDArray[np.float32], matrix: NDArray[np.float32], width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See `_points_in`; `matrix` (3, 4): pixels and depth, times depth, from the map."""
    pixel, depth = np.empty((len(points), 2), np.float32), np.empty(len(points), np.float32)
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        far = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        if far <= np.float32(NEAR_PLANE):
            continue
        u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / far
        v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / far
        if u > 0 and v > 0 and u < width - 1 and v < height - 1:
            pixel[count, 0], pixel[count, 1], depth[count] = u, v, far
            count += 1
    return pixel[:count].copy(), depth[:count].copy()


@njit(cache=True, nogil=True)
def _along(
    pixel: NDArray[np.float32], depth: NDArray[np.float32], ends: FloatArray, length: float, reach: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of the pixels (M, 2) within `reach` of a segment (2, 2): place along it and aside [px], and depth [m] (N,)."""
    place, aside, there = np.empty(len(pixel)), np.empty(len(pixel)), np.empty(len(pixel))
    ax, ay = (ends[1, 0] - ends[0, 0]) / length, (ends[1, 1] - ends[0, 1]) / length
    count = 0
    for i in range(len(pixel)):
        x, y = pixel[i, 0] - ends[0, 0], pixel[i, 1] - ends[0, 1]
        at, off = x * ax + y * ay, y * ax - x * ay
        if 0.0 < at < length and abs(off) < reach:
            place[count], aside[count], there[count] = at, off, depth[i]
            count += 1
    return place[:count].copy(), aside[:count].copy(), there[:count].copy()


def between_outlines(found: SegmentPairs, known: Sequence[Cylinder], view: View) -> NDArray[np.bool_]:
    """Segment pairs (N,) whose sides are both outlines of known cylinders: what is seen between these is no pipe."""
    taken = np.zeros((len(found), 2), bool)
    if not len(found):
        return taken[:, 0]
    along = found.ends[:, 1] - found.ends[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    half = 0.5 * found.width[..., None] * across[:, None]
    sides = np.stack([found.ends - half, found.ends + half], axis=1)  # (N, side, end, 2)
    for cylinder in known:
        outline = contour_samples(cylinder, [view], np.eye(3)[:2], spacing=OUTLINE_SPACING, margin=0.0)
        for side in (0, 1):
            line = outline.pixel[outline.side == side]
            if len(line) < 2:
                continue
            run = line[-1] - line[0]
            length = float(np.linalg.norm(run))
            offset = (sides - line[0]) / length
            place = offset @ run / length
            aside = np.abs(offset @ np.array([-run[1], run[0]]))
            common = np.minimum(place.max(axis=2), 1.0) - np.maximum(place.min(axis=2), 0.0)
            along_it = common > 0.5 * (place.max(axis=2) - place.min(axis=2))
            taken |= along_it & (aside < ON_OUTLINE).all(axis=2)
    return taken[:, 0] & taken[:, 1]


def rays(pair_view: PairView) -> FloatArray:
    """Directions (N, 2, 3) with unit depth, in the camera's frame, of the segment pairs' ends."""
    camera = pair_view.view.camera
    ends = pair_view.pairs.ends
    x = (ends[..., 0] - camera.cx) / camera.fx
    y = (ends[..., 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def centre_lines(found: SegmentPairs) -> FloatArray:
    """Lines (N, 3) through the segment pairs' ends with unit normals: line . (x, y, 1) is the distance [px]."""
    along = found.ends[:, 1] - found.ends[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    return np.concatenate([normal, -np.einsum("ij,ij->i", normal, found.ends[:, 0])[:, None]], axis=1)
