# SPDX-License-Identifier: Apache-2.0
"""Large planes (walls, floor, ceiling, ducts): never part of a pipe, and known when a pipe before them is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.octree import Cells, Octree, decode, encode

# Deviation [m] of a wall, and of a fused cloud of it, from a plane over a few decimetres.
_WALL_WAVINESS = 1e-3
# Cells [m] whose flatness is judged: wide enough that noise of millimetres does not turn their normals by 12 deg, which
# neighbours of one wall agree within, and narrow enough for the front of a duct.
_FLAT_CELL = 0.0625


@dataclass(frozen=True)
class Plane:
    """A bounded plane: unit normal (3,), offset [m] (normal . x = offset), area [m2] of its occupied cells."""

    normal: FloatArray
    offset: float
    area: float


def find_planes(tree: Octree, sigma: float, widest_radius: float) -> tuple[list[Plane], NDArray[np.bool_]]:
    """Planes too wide to be a strip of a pipe, and which points (N,) of the tree lie on one.

    Flat cells grow into regions of one plane. On a cylinder of radius R the strip within +-b of a plane is
    2 sqrt(4 R b) wide at most, so a region wider than that for the widest pipe sought is none of its surface.
    """
    cells = tree.cells(tree.level_of(_FLAT_CELL))
    band = 3.0 * sigma + _WALL_WAVINESS
    least_width = max(2.4 * np.sqrt(4.0 * widest_radius * band), 3.0 * cells.size)
    mean, normal, thickness, breadth, weight = _cell_planes(tree.points, cells.starts)
    flat = (thickness < 1.7 * sigma + 0.5 * _WALL_WAVINESS) & (breadth > 0.15 * cells.size) & (weight >= 8)
    neighbours = _cell_neighbours(cells)
    label = _grow(mean, normal, thickness, flat, neighbours, band, np.cos(np.radians(12.0)))
    planes: list[Plane] = []
    taken = np.zeros(len(tree.points), bool)
    sizes = np.bincount(label[label >= 0]) if (label >= 0).any() else np.zeros(0, int)
    for region in np.argsort(-sizes, kind="stable"):
        members = np.flatnonzero(label == region)
        if sizes[region] * cells.size**2 < least_width**2:
            break
        centre = np.average(mean[members], axis=0, weights=weight[members])
        spread, axes = np.linalg.eigh(np.cov((mean[members] - centre).T))
        # A filled strip of width w spreads w / sqrt(12).
        if np.sqrt(12.0 * max(spread[1], 0.0)) + cells.size < least_width:
            continue
        plane = Plane(axes[:, 0], float(axes[:, 0] @ centre), float(sizes[region]) * cells.size**2)
        planes.append(plane)
        taken[_on_region(tree, cells, plane, members, neighbours, mean, band)] = True
    return planes, taken


def _on_region(
    tree: Octree, cells: Cells, plane: Plane, members: IntArray, neighbours: IntArray, mean: FloatArray, band: float
) -> IntArray:
    """Rows of the points within `band` of the locally smoothed region (walls are wavy), in its cells and around."""
    offset: FloatArray = np.full(len(mean), np.nan)
    offset[members] = mean[members] @ plane.normal - plane.offset
    # The offset of a cell outside is the mean of its neighbours inside, twice over.
    ring = members
    for _ in range(2):
        ring = np.unique(neighbours[ring])
        ring = ring[ring >= 0]
        outside = ring[np.isnan(offset[ring])]
        around = np.where(neighbours[outside] >= 0, offset[neighbours[outside]], np.nan)
        count = np.isfinite(around).sum(axis=1)
        offset[outside] = np.nansum(around, axis=1) / np.maximum(count, 1)
    near = np.flatnonzero(np.isfinite(offset))
    rows = np.concatenate([np.arange(cells.starts[c], cells.starts[c + 1]) for c in near])
    height = tree.points[rows] @ plane.normal - plane.offset - np.repeat(offset[near], cells.counts[near])
    return np.asarray(rows[np.abs(height) < band])


@njit(cache=True, nogil=True)
def _cell_planes(
    points: FloatArray, starts: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    count = len(starts) - 1
    mean, normal = np.zeros((count, 3)), np.zeros((count, 3))
    thickness, breadth = np.zeros(count), np.zeros(count)
    weight = np.zeros(count, np.int64)
    for c in range(count):
        near = points[starts[c] : starts[c + 1]]
        weight[c] = len(near)
        if len(near) < 8:
            continue
        for i in range(len(near)):
            mean[c] += near[i]
        mean[c] /= len(near)
        scatter = np.zeros((3, 3))
        for i in range(len(near)):
            for a in range(3):
                for b in range(3):
                    scatter[a, b] += (near[i, a] - mean[c, a]) * (near[i, b] - mean[c, b])
        values, vectors = np.linalg.eigh(scatter / len(near))
        normal[c] = vectors[:, 0]
        thickness[c] = np.sqrt(max(values[0], 0.0))
        breadth[c] = np.sqrt(max(values[1], 0.0))
    return mean, normal, thickness, breadth, weight


def _cell_neighbours(cells: Cells) -> IntArray:
    """Rows (M, 26) of the occupied cells around each cell, -1 where there is none."""
    grid = decode(cells.keys)
    out = np.full((len(cells.keys), 26), -1, np.int64)
    steps = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0)]
    for column, step in enumerate(steps):
        other = grid + step
        inside = (other >= 0).all(axis=1)
        keys = encode(np.maximum(other, 0))
        at = np.minimum(np.searchsorted(cells.keys, keys), len(cells.keys) - 1)
        out[:, column] = np.where(inside & (cells.keys[at] == keys), at, -1)
    return out


@njit(cache=True, nogil=True)
def _grow(
    mean: FloatArray,
    normal: FloatArray,
    thickness: FloatArray,
    flat: NDArray[np.bool_],
    neighbours: IntArray,
    band: float,
    cosine: float,
) -> IntArray:
    """Label of the region of each cell, -1 for none: grown from the flattest cells, the region's normal kept up."""
    label = np.full(len(mean), -1, np.int64)
    queue = np.empty(len(mean), np.int64)
    region = 0
    for seed in np.argsort(thickness):
        if not flat[seed] or label[seed] >= 0:
            continue
        label[seed] = region
        queue[0] = seed
        head, tail = 0, 1
        direction = normal[seed].copy()
        centre = mean[seed].copy()
        while head < tail:
            cell = queue[head]
            head += 1
            for k in range(neighbours.shape[1]):
                other = neighbours[cell, k]
                if other < 0 or not flat[other] or label[other] >= 0:
                    continue
                along = normal[other] @ direction
                step = abs(normal[cell] @ (mean[other] - mean[cell]))
                if abs(along) < cosine or step > band or abs(direction @ (mean[other] - centre)) > 3.0 * band:
                    continue
                label[other] = region
                queue[tail] = other
                tail += 1
                weight = 1.0 / tail
                direction += weight * (normal[other] * (1.0 if along > 0 else -1.0) - direction)
                direction /= np.sqrt(direction @ direction)
                centre += weight * (mean[other] - centre)
        region += 1
    return label
