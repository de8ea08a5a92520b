# SPDX-License-Identifier: Apache-2.0
"""A linear octree: points sorted along the Morton curve, so that each cell of every level is one range of the array.

One sort serves voxel thinning, neighbour search and gathering at all scales, and makes every later step independent
of the order in which the points came.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray

# Cells [m] by which points near a segment are looked up: about as wide as a pipe, so that few cells lie near one and
# few of their points do not. The nearest level of the tree is taken.
_LOOKUP_CELL = 0.0625
# 21 bits an axis fill an int64 key; 1/32 mm is far below any cloud's noise and spans 65 m.
_BITS = 21
_FINEST = 2.0**-15


@dataclass(frozen=True)
class Cells:
    """Occupied cells of one level: keys (M,) ascending, and the range starts[i]:starts[i + 1] of the points in each."""

    level: int
    size: float
    keys: IntArray
    starts: IntArray

    @property
    def counts(self) -> IntArray:
        """Points in each cell (M,)."""
        return np.diff(self.starts)


@dataclass(frozen=True)
class Octree:
    """Points (N, 3) float64 [m] in Morton order with their keys (N,), and `order`, their rows in the given array."""

    points: FloatArray
    keys: IntArray
    order: IntArray
    origin: FloatArray
    quantum: float
    _cells: dict[int, Cells] = field(default_factory=dict, repr=False, compare=False)
    _centres: dict[int, FloatArray] = field(default_factory=dict, repr=False, compare=False)

    def level_of(self, size: float) -> int:
        """Level whose cells are nearest in size (in octaves) to `size` [m]."""
        return int(np.clip(round(np.log2(size / self.quantum)), 0, _BITS))

    def cells(self, level: int) -> Cells:
        """The occupied cells of a level; their edge is quantum * 2**level."""
        if level not in self._cells:
            keys = self.keys >> (3 * level)
            first = np.flatnonzero(np.diff(keys, prepend=keys[0] - 1)) if len(keys) else np.zeros(0, np.int64)
            self._cells[level] = Cells(level, self.quantum * 2.0**level, keys[first], np.append(first, len(keys)))
        return self._cells[level]

    def centres(self, cells: Cells) -> FloatArray:
        """Centres of cells (M, 3) [m]."""
        if cells.level not in self._centres:
            self._centres[cells.level] = self.origin + (decode(cells.keys) + 0.5) * cells.size
        return self._centres[cells.level]

    def subset(self, mask: NDArray[np.bool_]) -> Octree:
        """The tree of the points where mask (N,) is true."""
        return Octree(self.points[mask], self.keys[mask], self.order[mask], self.origin, self.quantum)

    def thinned(self, level: int) -> Octree:
        """One point, the mean, for each occupied cell of a level; `order` counts the cells."""
        cells = self.cells(level)
        if not len(cells.keys):
            return self
        means = np.add.reduceat(self.points, cells.starts[:-1], axis=0) / cells.counts[:, None]
        index = np.arange(len(means))
        # The mean lies in its cell; its own key keeps the order of the cells.
        keys = encode(_grid(means, self.origin, self.quantum))
        rank = np.argsort(keys, kind="stable")
        return Octree(means[rank], keys[rank], index[rank], self.origin, self.quantum)

    def near_segment(self, start: FloatArray, end: FloatArray, distance: float) -> IntArray:
        """Rows, ascending, of the points in the cylinder of radius `distance` [m] with flat ends about a segment."""
        cells = self.cells(self.level_of(_LOOKUP_CELL))
        length = float(np.linalg.norm(end - start))
        axis = (end - start) / length
        slack = 0.5 * float(np.sqrt(3.0)) * cells.size
        centres = self.centres(cells)
        return _near_segment(self.points, cells.starts, centres, slack, start, axis, length, distance)


def build(points: FloatArray) -> Octree:
    """Sort points (N, 3) [m] along the Morton curve; equal keys are sorted by coordinates, so input order is lost."""
    if not len(points):
        return Octree(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(3), _FINEST)
    origin = points.min(axis=0)
    extent = float((points.max(axis=0) - origin).max())
    quantum = _FINEST
    while extent / quantum >= 2**_BITS - 1:
        quantum *= 2.0
    keys = encode(_grid(points, origin, quantum))
    order = np.argsort(keys)
    keys = keys[order]
    same = keys[1:] == keys[:-1]
    tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
    if len(tied):
        rows = points[order[tied]]
        order[tied] = order[tied][np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0], keys[tied]))]
    return Octree(points[order], keys, order, origin, quantum)


@njit(cache=True, nogil=True)
def _spread(value: int) -> int:
    """Put two zero bits before each of the 21 low bits."""
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


@njit(cache=True, nogil=True)
def _gather(value: int) -> int:
    """Undo _spread."""
    value &= 0x1249249249249249
    value = (value | value >> 2) & 0x10C30C30C30C30C3
    value = (value | value >> 4) & 0x100F00F00F00F00F
    value = (value | value >> 8) & 0x1F0000FF0000FF
    value = (value | value >> 16) & 0x1F00000000FFFF
    return (value | value >> 32) & 0x1FFFFF


@njit(cache=True, nogil=True)
def _grid(points: FloatArray, origin: FloatArray, quantum: float) -> IntArray:
    out = np.empty(points.shape, np.int64)
    for i in range(len(points)):
        for k in range(3):
            out[i, k] = int((points[i, k] - origin[k]) / quantum)
    return out


@njit(cache=True, nogil=True)
def encode(grid: IntArray) -> IntArray:
    """Morton keys (N,) of cells (N, 3), 21 bits a coordinate."""
    keys = np.empty(len(grid), np.int64)
    for i in range(len(grid)):
        keys[i] = _spread(grid[i, 0]) << 2 | _spread(grid[i, 1]) << 1 | _spread(grid[i, 2])
    return keys


@njit(cache=True, nogil=True)
def decode(keys: IntArray) -> IntArray:
    """Cells (N, 3) of Morton keys (N,)."""
    grid = np.empty((len(keys), 3), np.int64)
    for i in range(len(keys)):
        grid[i, 0] = _gather(keys[i] >> 2)
        grid[i, 1] = _gather(keys[i] >> 1)
        grid[i, 2] = _gather(keys[i])
    return grid


@njit(cache=True, nogil=True)
def neighbour_ranges(key: int, cell_keys: IntArray, cell_starts: IntArray, level: int, ranges: IntArray) -> int:
    """Ranges of the points in the 27 cells around cell `key`, written to ranges (27, 2); returns the number of them."""
    limit = 1 << (_BITS - level)
    x, y, z = _gather(key >> 2), _gather(key >> 1), _gather(key)
    found = 0
    for i in range(max(x - 1, 0), min(x + 2, limit)):
        for j in range(max(y - 1, 0), min(y + 2, limit)):
            for k in range(max(z - 1, 0), min(z + 2, limit)):
                wanted = _spread(i) << 2 | _spread(j) << 1 | _spread(k)
                at = np.searchsorted(cell_keys, wanted)
                if at < len(cell_keys) and cell_keys[at] == wanted:
                    ranges[found, 0] = cell_starts[at]
                    ranges[found, 1] = cell_starts[at + 1]
                    found += 1
    return found


@njit(cache=True, nogil=True)
def _near_segment(
    points: FloatArray,
    starts: IntArray,
    centres: FloatArray,
    slack: float,
    start: FloatArray,
    axis: FloatArray,
    length: float,
    distance: float,
) -> IntArray:
    """Rows of the points near a segment, looked for in cells whose points lie within `slack` [m] of their centres."""
    close = np.empty(len(centres), np.int64)
    cells, most = 0, 0
    for c in range(len(centres)):
        along, square = _along_square(centres[c], start, axis)
        if -slack < along < length + slack and square < (distance + slack) ** 2:
            close[cells] = c
            cells += 1
            most += starts[c + 1] - starts[c]
    rows = np.empty(most, np.int64)
    count = 0
    for c in close[:cells]:
        for i in range(starts[c], starts[c + 1]):
            along, square = _along_square(points[i], start, axis)
            if 0.0 <= along <= length and square < distance * distance:
                rows[count] = i
                count += 1
    return rows[:count].copy()


@njit(cache=True, nogil=True)
def _along_square(point: FloatArray, start: FloatArray, axis: FloatArray) -> tuple[float, float]:
    """Position along the axis [m] and square of the distance from it."""
    x, y, z = point[0] - start[0], point[1] - start[1], point[2] - start[2]
    along = x * axis[0] + y * axis[1] + z * axis[2]
    return along, x * x + y * y + z * z - along * along
