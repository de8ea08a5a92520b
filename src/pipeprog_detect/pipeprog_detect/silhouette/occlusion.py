"""What stands before what: coarse depth images of the cloud, so that a hidden stretch is no evidence against a pipe."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.octree import THREADS
from pipeprog_detect.types import View

# Cells across an image, and the points that fill them: some in each cell of a view that shows a seventh of them.
COLUMNS, MOST_POINTS = 160, 1_200_000
# Fewer points in a cell are strays of the stereo.
LEAST_POINTS = 2
# What lies so much nearer [m] than a surface hides it; stereo spreads edges, and clamps lie upon pipes.
BEFORE = 0.03


def with_depths(views: Sequence[View], points: NDArray[np.floating]) -> list[View]:
    """The views, each with what the cloud's points (N, 3) show of the depth of the nearest surface."""
    some = np.ascontiguousarray(points[:: max(-(-len(points) // MOST_POINTS), 1)], np.float32)

    def seen(view: View) -> View:
        camera = view.camera
        cell = camera.width / COLUMNS
        rows = max(int(np.ceil(camera.height / cell)), 1)
        pose = view.camera_from_map[:3].astype(np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        return replace(view, nearest=_nearest(some, pose, lens, np.float32(cell), rows, COLUMNS, LEAST_POINTS))

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(seen, views))


def behind(view: View, pixel: FloatArray, depth: FloatArray) -> NDArray[np.bool_]:
    """Which points (N,) of one surface, seen at pixel (N, 2) at depth (N,) [m], something in the cloud hides."""
    if view.nearest is None or not len(depth):
        return np.zeros(len(depth), bool)
    cell = view.camera.width / view.nearest.shape[1]
    row, column = (
        np.clip((pixel[:, axis] / cell).astype(np.int64), 0, view.nearest.shape[1 - axis] - 1) for axis in (1, 0)
    )
    # A surface seen at a slant is nearer at one edge of the cell than at the other: inverse depth is linear in pixels.
    slope = float(np.ptp(1.0 / depth)) / max(float(np.linalg.norm(np.ptp(pixel, axis=0))), cell)
    slant = slope * cell * depth**2
    return np.asarray(view.nearest[row, column] < depth - BEFORE - slant, bool)


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
        if depth < np.float32(0.05):
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
