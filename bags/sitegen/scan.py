# SPDX-License-Identifier: Apache-2.0
"""The point cloud of a laser scanner: the first hits of its rays, with noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from sitegen.primitives import Primitive
from sitegen.raycast import STACK, PackedTree, build_tree, nearest

FloatArray = NDArray[np.float64]

_MIN_COSINE = 0.25  # of the angle of incidence, 76 degrees; beyond, a surface gives no return


def scan(
    primitives: Sequence[Primitive],
    stations: ArrayLike,
    aims: FloatArray,
    noise: float,
    rng: np.random.Generator,
    lateral: float = 0.35,
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Points (N, 3) [m], their normals (N, 3) towards the scanner, and which primitive each lies on (N,).

    From each of the stations (S, 3) a ray goes through each of the aims (A, 3). The noise, a standard deviation [m],
    is along the ray; across it, it is the share `lateral` of that.
    """
    tree = build_tree(primitives).packed()
    geometry = tree[1]
    points, normals, owners = [], [], []
    for station in np.atleast_2d(np.asarray(stations, float)):
        rays = aims - station
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        distance, local, owner = _first_hits(tree, station, rays)
        rows = geometry[np.maximum(owner, 0), 3:12].reshape(-1, 3, 3)
        normal = np.einsum("nij,ni->nj", rows, local)
        cosine = -np.einsum("ij,ij->i", normal, rays)
        normal *= np.sign(cosine)[:, None]
        seen = (owner >= 0) & (np.abs(cosine) > _MIN_COSINE)
        rays, distance = rays[seen], distance[seen]
        off = lateral * noise * rng.standard_normal(rays.shape)
        along = noise * np.sqrt(1.0 - lateral**2) * rng.standard_normal(len(rays))
        points.append(station + (distance + along)[:, None] * rays + off)
        normals.append(normal[seen])
        owners.append(owner[seen])
    return np.concatenate(points), np.concatenate(normals), np.concatenate(owners)


@njit(nogil=True)
def _first_hits(
    tree: PackedTree, origin: FloatArray, rays: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Distance, local normal and primitive (-1: none) of what each ray meets first."""
    distance, normal = np.zeros(len(rays)), np.zeros((len(rays), 3))
    owner = np.full(len(rays), -1, np.int64)
    stack = np.zeros(STACK, np.int64)
    for i in range(len(rays)):
        best, hit = nearest(tree, stack, (origin[0], origin[1], origin[2], rays[i, 0], rays[i, 1], rays[i, 2]))
        owner[i] = best
        if best >= 0:
            distance[i] = hit[0]
            normal[i, 0], normal[i, 1], normal[i, 2] = hit[4], hit[5], hit[6]
    return distance, normal, owner
