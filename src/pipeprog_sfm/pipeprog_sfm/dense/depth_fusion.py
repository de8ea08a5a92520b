# SPDX-License-Identifier: Apache-2.0
"""The dense cloud: depth maps that agree with each other, merged in a voxel hash."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.config import FusionConfig
from pipeprog_sfm.dense.depth_sampling import depth_at
from pipeprog_sfm.dense.stereo import DepthMap

AGREEMENT = 0.01  # relative difference of depth up to which two views have seen the same surface
OVERLAP_MIN = 0.15  # share of a view that another one must see to be compared with it
VIEW_ANGLE_MAX = np.radians(60.0)  # between optical axes; beyond, one of the two sees a common surface obliquely
GRAZING_COS = 0.17  # surfaces seen at less than 10 degrees carry no usable depth


@dataclass(frozen=True)
class FusedCloud:
    """Points of the scene: (N, 3) float32 points and unit normals towards the cameras in `map`, metres;
    (N, 3) uint8 RGB colors; (N,) uint8 views, the depth maps that agree on the point."""

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    views: NDArray[np.uint8]


@dataclass(frozen=True)
class _View:
    depth: NDArray[np.float32]  # metres, NaN where unknown
    matrix: FloatArray  # K
    camera_from_map: FloatArray


class Fusion:
    """Merges depth maps as they are made; a map adds the points that earlier maps confirm."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._views: list[_View] = []
        self._hash = _VoxelHash(config.voxel)

    def add(self, depth_map: DepthMap, camera_from_map: FloatArray, scale: float) -> None:
        """Merges a depth map: its pose is in metres, `scale` the metres per unit of its depth."""
        view = _View(depth_map.depth * np.float32(scale), depth_map.camera.matrix, np.asarray(camera_from_map, float))
        neighbours = self._overlapping(view)
        self._views.append(view)
        if len(self._views) > self._config.max_maps:
            self._views.pop(0)
        if len(neighbours) < self._config.min_views - 1:
            return
        depth, normal, agreeing = _confirm(
            view.depth,
            _stacked([other.depth for other in neighbours]),
            view.matrix,
            np.stack([other.matrix for other in neighbours]),
            np.stack([other.camera_from_map @ np.linalg.inv(view.camera_from_map) for other in neighbours]),
            AGREEMENT,
            self._config.min_views - 1,
        )
        self._hash.add(
            depth, normal, agreeing, depth_map.color, view.matrix, np.linalg.inv(view.camera_from_map).astype(float)
        )

    def cloud(self) -> FusedCloud:
        """The cloud so far, in the order in which its voxels were first seen."""
        return self._hash.cloud()

    def _overlapping(self, view: _View) -> list[_View]:
        """The earlier views that see most of what this one sees, in order of time."""
        height, width = view.depth.shape
        rows, columns = (
            a.ravel()
            for a in np.meshgrid(np.linspace(0, height - 1, 12, dtype=int), np.linspace(0, width - 1, 20, dtype=int))
        )
        z = view.depth[rows, columns].astype(float)
        known = np.isfinite(z)
        if not known.any():
            return []
        rays = np.linalg.inv(view.matrix) @ np.stack([columns[known], rows[known], np.ones(known.sum())])
        points = np.r_[rays * z[known], np.ones((1, known.sum()))]
        shares = []
        for index, other in enumerate(self._views):
            other_from_view = other.camera_from_map @ np.linalg.inv(view.camera_from_map)
            if other_from_view[2, 2] < np.cos(VIEW_ANGLE_MAX):
                continue
            seen = other.matrix @ (other_from_view @ points)[:3]
            pixel = seen[:2] / np.maximum(seen[2], 1e-9)
            inside = (
                (seen[2] > 0)
                & (pixel >= 0).all(axis=0)
                & (pixel < [[other.depth.shape[1]], [other.depth.shape[0]]]).all(axis=0)
            )
            if inside.mean() >= OVERLAP_MIN:
                shares.append((-inside.mean(), index))
        best = sorted(index for _, index in sorted(shares)[: self._config.max_neighbours])
        return [self._views[index] for index in best]


def _stacked(depths: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """(N, h, w) of depth maps; where a camera has switched its size, the smaller ones are unknown (NaN) outside."""
    if all(depth.shape == depths[0].shape for depth in depths):
        return np.stack(depths)
    stack = np.full((len(depths), *np.max([depth.shape for depth in depths], axis=0)), np.nan, np.float32)
    for layer, depth in zip(stack, depths, strict=True):
        layer[: depth.shape[0], : depth.shape[1]] = depth
    return stack


class _VoxelHash:
    """Open addressing over packed voxel indices; sums per voxel, in the order of first sight."""

    def __init__(self, voxel: float) -> None:
        self._voxel = voxel
        self._table = np.full(1 << 16, -1, np.int32)
        self._keys = np.empty(1 << 15, np.int64)
        self._sums = np.zeros((1 << 15, 10), np.float32)  # weight, offset from the voxel's corner, normal, colour
        self._views = np.zeros(1 << 15, np.uint8)
        self._size = 0

    def add(
        self,
        depth: NDArray[np.float32],
        normal: NDArray[np.float32],
        agreeing: NDArray[np.uint8],
        color: NDArray[np.uint8],
        matrix: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
    ) -> None:
        """Adds the pixels on which any view agrees, weighted by the number of views."""
        while 2 * (self._size + np.count_nonzero(agreeing)) > len(self._table):
            self._grow()
        self._size = _insert(
            self._table,
            self._keys,
            self._sums,
            self._views,
            self._size,
            self._voxel,
            depth,
            normal,
            agreeing,
            color,
            matrix,
            map_from_camera,
        )

    def cloud(self) -> FusedCloud:
        n = self._size
        points, normals, colors = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty((n, 3), np.uint8)
        _average(self._keys[:n], self._sums[:n], self._voxel, points, normals, colors)
        return FusedCloud(points, normals, colors, self._views[:n].copy())

    def _grow(self) -> None:
        self._table = np.full(2 * len(self._table), -1, np.int32)
        n = len(self._table) // 2
        self._keys = np.resize(self._keys, n)
        sums = np.zeros((n, self._sums.shape[1]), np.float32)
        sums[: self._size] = self._sums[: self._size]
        views = np.zeros(n, np.uint8)
        views[: self._size] = self._views[: self._size]
        self._sums, self._views = sums, views
        _rehash(self._table, self._keys, self._size)


_BITS = 21  # per axis: at 4 mm voxels the map may span 8 km
_HALF = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1


@njit(cache=True, nogil=True)
def _average(keys, sums, voxel, points, normals, colors):  # type: ignore[no-untyped-def]
    """Points, unit normals and colours of voxels from their keys and sums; in doubles, as the map may be kilometres."""
    for n in range(len(keys)):
        weight, square = np.float64(sums[n, 0]), 0.0
        for k in range(3):
            cell = ((keys[n] >> ((2 - k) * _BITS)) & _MASK) - _HALF
            points[n, k] = cell * voxel + np.float64(sums[n, 1 + k]) / weight
            square += (np.float64(sums[n, 4 + k]) / weight) ** 2
            colors[n, k] = min(max(np.rint(np.float64(sums[n, 7 + k]) / weight), 0.0), 255.0)
        length = max(np.sqrt(square), 1e-12)
        for k in range(3):
            normals[n, k] = np.float64(sums[n, 4 + k]) / weight / length


@njit(cache=True, nogil=True)
def _slot(table, keys, key):  # type: ignore[no-untyped-def]
    mask = len(table) - 1
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(h >> np.uint64(32)) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _insert(  # type: ignore[no-untyped-def]
    table, keys, sums, views, size, voxel, depth, normal, agreeing, color, matrix, map_from_camera
):
    height, width = depth.shape
    rotation = map_from_camera
    point, direction, cell = np.empty(3), np.empty(3), np.empty(3, np.int64)
    for v in range(height):
        for u in range(width):
            if agreeing[v, u] == 0:
                continue
            z = np.float64(depth[v, u])
            x, y = (u - matrix[0, 2]) / matrix[0, 0] * z, (v - matrix[1, 2]) / matrix[1, 1] * z
            nx, ny, nz = normal[v, u]
            key = np.int64(0)
            for k in range(3):
                point[k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + rotation[k, 3]
                direction[k] = rotation[k, 0] * nx + rotation[k, 1] * ny + rotation[k, 2] * nz
                cell[k] = np.int64(np.floor(point[k] / voxel))
                key = (key << _BITS) | ((cell[k] + _HALF) & _MASK)
            slot = _slot(table, keys, key)
            index = table[slot]
            if index < 0:
                index = size
                table[slot] = index
                keys[index] = key
                size += 1
            count = agreeing[v, u] + 1
            weight = np.float32(count)
            total = sums[index]
            total[0] += weight
            for k in range(3):
                total[1 + k] += weight * (point[k] - cell[k] * voxel)
                total[4 + k] += weight * direction[k]
                total[7 + k] += weight * color[v, u, 2 - k]  # BGR to RGB
            views[index] = max(views[index], count)
    return size


@njit(cache=True, nogil=True)
def _rehash(table, keys, size):  # type: ignore[no-untyped-def]
    for index in range(size):
        table[_slot(table, keys, keys[index])] = index


@njit(cache=True, nogil=True)
def _confirm(depth, others, matrix, other_matrices, others_from_view, agreement, agreeing_min):  # type: ignore[no-untyped-def]
    """Depth averaged with the views that agree, normals (camera frame, towards it), and how many agree (0: dropped).

    A view agrees when its own depth at the projection of a point differs by less than `agreement`; it contradicts
    when it sees farther than the point. What more views contradict than confirm is dropped.
    """
    height, width = depth.shape
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    fused = np.zeros((height, width), np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    agreeing = np.zeros((height, width), np.uint8)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if not z > 0.0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            total, count, contradicting = 0.0, 0, 0
            for n in range(len(others)):
                T = others_from_view[n]
                K = other_matrices[n]
                qz = (T[2, 0] * x + T[2, 1] * y + T[2, 2]) * z + T[2, 3]
                if qz <= 0.0:
                    continue
                qx = (T[0, 0] * x + T[0, 1] * y + T[0, 2]) * z + T[0, 3]
                qy = (T[1, 0] * x + T[1, 1] * y + T[1, 2]) * z + T[1, 3]
                seen = depth_at(others[n], K[0, 0] * qx / qz + K[0, 2], K[1, 1] * qy / qz + K[1, 2], agreement)
                if not seen > 0.0:
                    continue
                difference = (seen - qz) / qz
                if abs(difference) < agreement:
                    total += difference
                    count += 1
                elif difference > 0.0:
                    contradicting += 1
            if count < agreeing_min or contradicting > count:
                continue
            a, b, c = _inverse_depth_plane(depth, u, v, agreement)
            if a <= 0.0:
                continue
            # inverse depth of the plane n.X = -h is affine in the pixel: 1/z = -(n/h).(x, y, 1)
            nx, ny, nz = -b * fx, -c * fy, -(a - b * (u - cx) - c * (v - cy))
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / length, ny / length, nz / length
            if -(nx * x + ny * y + nz) < GRAZING_COS * np.sqrt(x * x + y * y + 1.0):
                continue
            fused[v, u] = z * (1.0 + total / (count + 1))
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = nx, ny, nz
            agreeing[v, u] = min(count, 254)
    return fused, normals, agreeing


@njit(cache=True, nogil=True)
def _inverse_depth_plane(depth, u, v, agreement):  # type: ignore[no-untyped-def]
    """Least squares 1/z = a + b du + c dv over the pixels around that lie on the same surface; a = 0 where too few."""
    height, width = depth.shape
    radius = 3
    z0 = depth[v, u]
    n, su, sv, suu, suv, svv, sw, swu, swv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(0, v - radius), min(height, v + radius + 1)):
        for j in range(max(0, u - radius), min(width, u + radius + 1)):
            z = depth[i, j]
            if not abs(z - z0) < agreement * z0:
                continue
            du, dv, w = float(j - u), float(i - v), 1.0 / z
            n += 1.0
            su += du
            sv += dv
            suu += du * du
            suv += du * dv
            svv += dv * dv
            sw += w
            swu += w * du
            swv += w * dv
    if n < 8.0:
        return 0.0, 0.0, 0.0
    cuu, cuv, cvv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    cwu, cwv = swu - sw * su / n, swv - sw * sv / n
    determinant = cuu * cvv - cuv * cuv
    if determinant < 1e-3 * cuu * cvv or determinant <= 0.0:
        return 0.0, 0.0, 0.0
    b = (cwu * cvv - cwv * cuv) / determinant
    c = (cwv * cuu - cwu * cuv) / determinant
    return (sw - b * su - c * sv) / n, b, c
