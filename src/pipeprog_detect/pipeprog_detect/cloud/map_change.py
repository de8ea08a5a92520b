# SPDX-License-Identifier: Apache-2.0
"""Where a map shows more than the one before, so that pipes are sought there alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Places are cells [m] with those next to them: an adjustment that moves the map by centimetres is no news.
_CELL = 0.1
# By what share a place has more points than before when it may show what it did not, and by how many standard
# deviations of two counts beyond that.
_MORE, _CERTAIN = 0.5, 4.0
# What surrounds news is sought again [m]: a pipe of which a part was there, and the widest patch that votes for one.
_CONTEXT = 0.4
_NEIGHBOURS = np.array(list(product((-1, 0, 1), repeat=3)))
_OFFSET, _BITS = 1 << 20, 21


class MapChange:
    """How many points a survey's last map had where, and the cylinders that were found in it."""

    def __init__(self) -> None:
        self._known: Sequence[Cylinder] = ()
        self._keys: NDArray[np.int64] = np.zeros(0, np.int64)
        self._counts: NDArray[np.int64] = np.zeros(0, np.int64)

    @property
    def known(self) -> Sequence[Cylinder]:
        """The cylinders of the last map, in its frame."""
        return self._known

    def remember(self, cylinders: Sequence[Cylinder]) -> None:
        """Takes the cylinders that were found in this map, in its frame, for the next one."""
        self._known = tuple(cylinders)

    def fresh(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which points (N, 3) [m] of a map lie about a place that shows more than it did in the last one.

        The map then counts as the last one.
        """
        grid = np.floor(points / _CELL).astype(np.int64)
        keys, cell_of, counts = np.unique(_key(grid), return_inverse=True, return_counts=True)
        cells = np.empty((len(keys), 3), np.int64)
        cells[cell_of] = grid
        before = _around(cells, self._keys, self._counts)
        now = _around(cells, keys, counts)
        self._keys, self._counts = keys, counts.astype(np.int64)
        news = now - (1.0 + _MORE) * before > _CERTAIN * np.sqrt(now + (1.0 + _MORE) ** 2 * before)
        if not news.any():
            return np.zeros(len(points), bool)
        gaps = cKDTree(_CELL * cells[news]).query(_CELL * cells, distance_upper_bound=_CONTEXT)[0]
        return np.asarray(np.isfinite(gaps)[cell_of])


def _key(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (grid + _OFFSET).T & ((1 << _BITS) - 1)
    return np.asarray((x << (2 * _BITS)) | (y << _BITS) | z)


def _around(cells: NDArray[np.int64], keys: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Points in each cell (M, 3) and those next to it, by the ascending keys (K,) of cells and their counts."""
    total = np.zeros(len(cells), np.int64)
    if not len(keys):
        return total
    for neighbour in _NEIGHBOURS:
        wanted = _key(cells + neighbour)
        row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        total += np.where(keys[row] == wanted, counts[row], 0)
    return total
