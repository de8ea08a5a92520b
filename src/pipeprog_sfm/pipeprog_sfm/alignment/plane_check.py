# SPDX-License-Identifier: Apache-2.0
"""Whether surfaces of two surveys lie in the same planes: the check of an alignment, never its proof.

A step of point-to-plane ICP (Chen and Medioni, 1992) says by how much the two clouds would still be moved; it moves
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray

MAX_POINTS = 20_000  # of the new survey that are asked: a share of them is then known to 0.4 %
REACH = 0.2  # m within which a surface of the reference is taken for the one that a point shows
ON_PLANE = 0.015  # m; a sparse point has 3 to 5 mm of noise two metres away, a surface 15 mm beside it is another one
MIN_SHARE = 0.5  # of the points near a surface that lie on it; of points spread evenly within REACH, 8 % do
MIN_CHECKED = 500  # points near surfaces, fewer say nothing
MIN_ACROSS = 200  # points on surfaces that stand across a board, in each direction: a share of them is known to 4 %
ACROSS = 0.5  # cosine between a surface's normal and the board's, at most
MAX_SHIFT = 0.01  # m by which the clouds may still want to be moved: half a cell of the thin cloud


@dataclass(frozen=True)
class PlaneCheck:
    """Number of points that have a surface of the reference near, the share of them on it, and the shift [m] left."""

    points: int
    share: float
    shift: float

    @property
    def contradiction(self) -> str:
        """What the surfaces say against the alignment; empty where they agree, or say nothing."""
        if self.points < MIN_CHECKED:
            return ""
        if self.share < MIN_SHARE:
            return f"{100 * self.share:.0f} % of its points lie on surfaces of the reference that are near them"
        if self.shift > MAX_SHIFT:
            return f"its surfaces lie {1e3 * self.shift:.0f} mm beside those of the reference"
        return ""


def check_planes(points: FloatArray, cloud: NDArray[np.float32], normals: NDArray[np.float32]) -> PlaneCheck:
    """Compares (N, 3) points of a survey with the reference's (M, 3) cloud and normals, all in one frame."""
    own, normal, off = _offsets(points, cloud, normals)
    count = len(own)
    if not count:
        return PlaneCheck(0, 0.0, 0.0)
    on = np.abs(off) < ON_PLANE
    middle = own.mean(0)
    rows = np.concatenate([normal, np.cross(own - middle, normal)], axis=1)
    weight = np.where(np.abs(off) < 2 * ON_PLANE, (1 - (off / (2 * ON_PLANE)) ** 2) ** 2, 0.0)  # Tukey's biweight
    matrix = np.einsum("ki,kj->ij", rows * weight[:, None], rows)
    gradient = (rows * (weight * off)[:, None]).sum(0)
    # A direction that no plane holds must not be told as a shift: it is left where the alignment has it.
    held = matrix + np.eye(6) * 1e-3 * np.trace(matrix) / 6
    step = np.linalg.solve(held, -gradient) if weight.any() else np.zeros(6)
    return PlaneCheck(count, float(on.mean()), float(np.linalg.norm(step[:3])))


def agree_across(
    points: FloatArray, cloud: NDArray[np.float32], normals: NDArray[np.float32], board_normal: FloatArray
) -> bool:
    """Whether surfaces that stand across a board agree in both directions of its plane; arguments as `check_planes`.

    The wall that a board hangs on agrees in any room with that board: the floor and a side wall tell where on it.
    """
    _, normal, off = _offsets(points, cloud, normals)
    across = np.abs(normal @ board_normal) < ACROSS
    if not across.any() or (np.abs(off[across]) < ON_PLANE).mean() < MIN_SHARE:
        return False
    held = normal[across & (np.abs(off) < ON_PLANE)]
    in_plane = held - np.outer(held @ board_normal, board_normal)
    # The least of the three is that along the board's normal, which is zero.
    return bool(np.linalg.eigvalsh(in_plane.T @ in_plane)[1] > MIN_ACROSS)


def _offsets(
    points: FloatArray, cloud: NDArray[np.float32], normals: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points near the reference's surfaces, the normals of these (K, 3) each, and how far from them they are (K,)."""
    points = points[:: max(len(points) // MAX_POINTS, 1)].astype(float)
    if not len(cloud) or not len(points):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    distance, nearest = cKDTree(cloud).query(points, distance_upper_bound=REACH)
    near = np.isfinite(distance)
    own, normal = points[near], normals[nearest[near]].astype(float)
    return own, normal, np.einsum("ij,ij->i", own - cloud[nearest[near]], normal)
