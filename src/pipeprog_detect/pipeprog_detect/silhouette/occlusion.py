# SPDX-License-Identifier: Apache-2.0
"""What hides a part of a pipe from a view (other pipes, the cloud): a hidden part is no evidence against the pipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import NEAR_PLANE, ContourSamples, parts_by_view
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View

# Cells across an image, and points at the most that fill them: 12 in each of the 160 x 90 cells of a view that shows a
# seventh of the points.
COLUMNS, MOST_POINTS = 160, 1_200_000
# The second nearest point of a cell counts: a single one may be a stray of the stereo.
LEAST_POINTS = 2
# A cell that shows what is farther than all eight around it is a hole of the cloud, not a gap in what hides the rest.
AROUND = np.array([[True, True, True], [True, False, True], [True, True, True]])
# A surface is hidden by what lies nearer by more than this [m]: stereo spreads depth edges by about a centimetre, and
# clamps stand out from the pipe that they hold by up to two.
BEFORE = 0.03
# Width of what stereo compares first [px]: windows of 5 px at a quarter of the size of its images.
STEREO_WINDOW = 20.0
# Pixels by which other cylinders are grown: their poses are known to a pixel, an edge's window is two wide.
MARGIN = 3.0


def with_depths(
    views: Sequence[View], points: NDArray[np.floating], faces: NDArray[np.floating] | None = None
) -> list[View]:
    """The views, each with what the cloud's points (N, 3) show of the depth of the nearest surface.

    `faces`: points (M, 3) of surfaces that the cloud may not show (`board_faces`).
    """
    some = np.ascontiguousarray(points[:: max(-(-len(points) // MOST_POINTS), 1)], np.float32)
    if faces is not None:
        some = np.vstack([some, faces.astype(np.float32)])

    def seen(view: View) -> View:
        camera = view.camera
        cell = camera.width / COLUMNS
        rows = max(int(np.ceil(camera.height / cell)), 1)
        pose = view.camera_from_map[:3].astype(np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        nearest = _nearest(some, pose, lens, np.float32(cell), rows, COLUMNS, LEAST_POINTS)
        return replace(view, nearest=np.minimum(nearest, maximum_filter(nearest, footprint=AROUND)))

    return mapped(seen, views)


def visible(
    samples: ContourSamples, cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]
) -> NDArray[np.bool_]:
    """Mask (N,) of the cylinder's samples that neither one of the `others` nor the cloud hides from their view."""
    result = np.ones(len(samples), bool)
    rows = cylinder_rows(others)
    for index, part in parts_by_view(samples, len(views)):
        view, pixel = views[index], samples.pixel[part]
        towards = view.camera_from_map[2, :3]
        depth = samples.along[part] * (cylinder.axis @ towards) + (cylinder.middle - view.centre) @ towards
        hidden = hidden_by_cylinders(view, pixel, depth, rows)
        result[part] = ~(hidden | hidden_by_cloud(view, pixel, depth - cylinder.radius))
    return result


def on_contours(samples: ContourSamples, views: Sequence[View], others: Sequence[Cylinder]) -> NDArray[np.bool_]:
    """Mask (N,) of the samples that lie on the contour of one of the `others`, whose edges they show."""
    result = np.zeros(len(samples), bool)
    rows = cylinder_rows(others)
    for index, part in parts_by_view(samples, len(views)):
        view = views[index]
        rotation = np.ascontiguousarray(view.camera_from_map[:3, :3])
        result[part] = _grazing(rows, view.centre, rotation, _lens(view), samples.pixel[part], MARGIN / view.camera.fx)
    return result


def cylinder_rows(cylinders: Sequence[Cylinder]) -> FloatArray:
    """The rows (K, 8) of cylinders, for `hidden_by_cylinders`."""
    return np.stack([each.row for each in cylinders]) if cylinders else np.empty((0, 8))


def hidden_by_cylinders(view: View, pixel: FloatArray, depth: FloatArray, cylinders: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of points, seen at pixel (N, 2) at depth (N,) [m], behind one of the cylinders grown by `MARGIN`.

    `cylinders` (K, 8): as `cylinder_rows` gives them.
    """
    rotation = np.ascontiguousarray(view.camera_from_map[:3, :3])
    return _passing(cylinders, view.centre, rotation, _lens(view), pixel, depth, MARGIN / view.camera.fx)


def depth_of_cylinders(view: View, pixel: FloatArray, cylinders: FloatArray) -> FloatArray:
    """Depth (N,) [m] at which the lines of sight through pixel (N, 2) meet the first cylinder; infinite: none.

    `cylinders` (K, 8): as `cylinder_rows` gives them.
    """
    rotation = np.ascontiguousarray(view.camera_from_map[:3, :3])
    return _first_met(cylinders, view.centre, rotation, _lens(view), pixel)


def _lens(view: View) -> FloatArray:
    return np.array([view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy])


@njit(cache=True, nogil=True)
def _passing(
    cylinders: FloatArray,
    centre: FloatArray,
    rotation: FloatArray,
    lens: FloatArray,
    pixel: FloatArray,
    own_depth: FloatArray,
    margin: float,
) -> NDArray[np.bool_]:
    """Mask (N,) of pixel (N, 2) whose lines of sight meet a cylinder, grown by `margin` x depth, before `own_depth`.

    `rotation` (3, 3): camera_from_map; `lens`: fx, fy, cx, cy.
    """
    count = len(pixel)
    result = np.zeros(count, np.bool_)
    rays = _rays(rotation, lens, pixel)
    deepest = 0.0
    for i in range(count):
        deepest = max(deepest, own_depth[i])
    for k in range(len(cylinders)):
        axis, offset, before = _straight_to(cylinders[k], centre)
        length, radius = cylinders[k, 6], cylinders[k, 7]
        # A place within reach of the axis, and as far beyond its ends, is nearer to it than 1.5 reaches.
        grown = 1.5 * (radius + margin * deepest)
        left, right, top, bottom = _image_box(cylinders[k], grown, centre, rotation, lens, deepest)
        if left > right:
            continue
        for i in range(count):
            u, v = pixel[i, 0], pixel[i, 1]
            if result[i] or u < left or u > right or v < top or v > bottom:
                continue
            depth, along, square = _approach(rays[i], axis, offset)
            if depth <= 0.0 or depth >= own_depth[i]:
                continue
            reach = radius + margin * depth
            place = depth * along - before
            result[i] = square < reach * reach and -reach < place < length + reach
    return result


@njit(cache=True, nogil=True)
def _grazing(
    cylinders: FloatArray, centre: FloatArray, rotation: FloatArray, lens: FloatArray, pixel: FloatArray, margin: float
) -> NDArray[np.bool_]:
    """Mask (N,) of pixel (N, 2) whose lines of sight pass a cylinder's surface by less than `margin` x depth.

    For the other arguments see `_passing`.
    """
    count = len(pixel)
    result = np.zeros(count, np.bool_)
    rays = _rays(rotation, lens, pixel)
    for k in range(len(cylinders)):
        axis, offset, before = _straight_to(cylinders[k], centre)
        length, radius = cylinders[k, 6], cylinders[k, 7]
        for i in range(count):
            if result[i]:
                continue
            depth, along, square = _approach(rays[i], axis, offset)
            place = depth * along - before
            if depth > 0.0 and 0.0 < place < length:
                result[i] = abs(np.sqrt(square) - radius) < margin * depth
    return result


@njit(cache=True, nogil=True)
def _first_met(
    cylinders: FloatArray, centre: FloatArray, rotation: FloatArray, lens: FloatArray, pixel: FloatArray
) -> FloatArray:
    """See `depth_of_cylinders`; for the other arguments see `_passing`."""
    count = len(pixel)
    result = np.full(count, np.inf)
    rays = _rays(rotation, lens, pixel)
    for k in range(len(cylinders)):
        axis, offset, before = _straight_to(cylinders[k], centre)
        length, radius = cylinders[k, 6], cylinders[k, 7]
        left, right, top, bottom = _image_box(cylinders[k], radius, centre, rotation, lens, np.inf)
        if left > right:
            continue
        for i in range(count):
            u, v = pixel[i, 0], pixel[i, 1]
            if u < left or u > right or v < top or v > bottom:
                continue
            depth, along, square = _approach(rays[i], axis, offset)
            if depth <= 0.0 or square >= radius * radius:
                continue
            across = rays[i, 0] ** 2 + rays[i, 1] ** 2 + rays[i, 2] ** 2 - along * along
            depth -= np.sqrt((radius * radius - square) / max(across, 1e-12))
            if depth > 0.0 and 0.0 < depth * along - before < length:
                result[i] = min(result[i], depth)
    return result


@njit(cache=True, nogil=True)
def _image_box(
    cylinder: FloatArray, reach: float, centre: FloatArray, rotation: FloatArray, lens: FloatArray, deepest: float
) -> tuple[float, float, float, float]:
    """Bounds [px] (left, right, top, bottom) of all that is within `reach` [m] of a cylinder's (8,) axis.

    The image of a convex body before the camera lies in the bounds of what spans it: the boxes around both ends. Where
    a part of the body is not before the camera there are none; they hold nothing where it lies behind the camera, or
    behind the depth `deepest` [m].
    """
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    least, most = np.inf, -np.inf
    for end in range(2):
        run = end * cylinder[6]
        x = cylinder[0] + run * cylinder[3] - centre[0]
        y = cylinder[1] + run * cylinder[4] - centre[1]
        z = cylinder[2] + run * cylinder[5] - centre[2]
        u = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        v = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        least, most = min(least, depth), max(most, depth)
        for surface in (depth - reach, depth + reach):
            far = max(surface, NEAR_PLANE)
            left, right = min(left, (u - reach) / far), max(right, (u + reach) / far)
            top, bottom = min(top, (v - reach) / far), max(bottom, (v + reach) / far)
    if most + reach < 0.0 or least - reach > deepest:
        return np.inf, -np.inf, np.inf, -np.inf
    if least - reach < NEAR_PLANE:
        return -np.inf, np.inf, -np.inf, np.inf
    return lens[0] * left + lens[2], lens[0] * right + lens[2], lens[1] * top + lens[3], lens[1] * bottom + lens[3]


@njit(cache=True, nogil=True, inline="always")
def _straight_to(
    cylinder: FloatArray, centre: FloatArray
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Axis of a cylinder (8,), and the way straight to the axis from a camera's centre (3,).

    Also where its start lies along the axis, from the foot of that way on [m].
    """
    ax, ay, az = cylinder[3], cylinder[4], cylinder[5]
    x, y, z = cylinder[0] - centre[0], cylinder[1] - centre[1], cylinder[2] - centre[2]
    before = ax * x + ay * y + az * z
    return (ax, ay, az), (x - before * ax, y - before * ay, z - before * az), before


@njit(cache=True, nogil=True, inline="always")
def _approach(
    ray: FloatArray, axis: tuple[float, float, float], offset: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Where a line of sight (3,) comes nearest to an axis, `offset` straight from the camera: its depth [m].

    Also what a metre of depth is along the axis, and the square of the distance there [m^2].
    """
    along = ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2]
    u, v, w = ray[0] - along * axis[0], ray[1] - along * axis[1], ray[2] - along * axis[2]
    x, y, z = offset
    depth = (u * x + v * y + w * z) / max(u * u + v * v + w * w, 1e-12)
    return depth, along, (x - depth * u) ** 2 + (y - depth * v) ** 2 + (z - depth * w) ** 2


@njit(cache=True, nogil=True)
def _rays(rotation: FloatArray, lens: FloatArray, pixel: FloatArray) -> FloatArray:
    """Lines of sight (N, 3) of pixel (N, 2) in the map, one metre deep; see `_passing`."""
    rays = np.empty((len(pixel), 3))
    for i in range(len(pixel)):
        u, v = (pixel[i, 0] - lens[2]) / lens[0], (pixel[i, 1] - lens[3]) / lens[1]
        for k in range(3):
            rays[i, k] = u * rotation[0, k] + v * rotation[1, k] + rotation[2, k]
    return rays


def hidden_by_cloud(view: View, pixel: FloatArray, depth: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of points of one surface, seen at pixel (N, 2) at depth (N,) [m], behind something in the cloud."""
    if view.nearest is None or not len(depth):
        return np.zeros(len(depth), bool)
    return _behind(view.nearest, view.camera.width / view.nearest.shape[1], pixel, depth)


@njit(cache=True, nogil=True)
def _behind(nearest: NDArray[np.float32], cell: float, pixel: FloatArray, depth: FloatArray) -> NDArray[np.bool_]:
    """See `hidden_by_cloud`; `nearest` (h, w): depth [m] of the surface in each cell of `cell` [px]."""
    count = len(depth)
    rows, columns = nearest.shape
    low, high = pixel[0].copy(), pixel[0].copy()
    least, most = 1.0 / depth[0], 1.0 / depth[0]
    for i in range(count):
        for k in range(2):
            low[k], high[k] = min(low[k], pixel[i, k]), max(high[k], pixel[i, k])
        least, most = min(least, 1.0 / depth[i]), max(most, 1.0 / depth[i])
    # A surface seen at a slant is nearer at one edge of the cell than at the other: inverse depth is linear in pixels.
    slope = (most - least) / max(np.hypot(high[0] - low[0], high[1] - low[1]), cell)
    result = np.empty(count, np.bool_)
    for i in range(count):
        row = min(max(int(pixel[i, 1] / cell), 0), rows - 1)
        column = min(max(int(pixel[i, 0] / cell), 0), columns - 1)
        result[i] = nearest[row, column] < depth[i] - BEFORE - slope * cell * depth[i] ** 2
    return result


@njit(cache=True, nogil=True)
def _nearest(
    points: NDArray[np.float32],
    pose: NDArray[np.float32],
    lens: NDArray[np.float32],
    cell: np.float32,
    rows: int,
    columns: int,
    least: int,
) -> NDArray[np.float32]:
    """Depth [m] (rows, columns) of the `least`-th nearest point of each cell, infinite where there are fewer."""
    depths = np.full((rows, columns, least), np.inf, np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if depth < np.float32(NEAR_PLANE):
            continue
        u = (lens[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + lens[2]) / cell
        v = (lens[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + lens[3]) / cell
        if u < 0 or v < 0 or u >= columns or v >= rows:
            continue
        held = depths[int(v), int(u)]
        for k in range(least):
            if depth < held[k]:
                held[k], depth = depth, held[k]
    return depths[:, :, least - 1].copy()
