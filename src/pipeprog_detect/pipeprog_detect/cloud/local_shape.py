# SPDX-License-Identifier: Apache-2.0
"""Local surface shape: normal, principal curvature and its direction from a quadric around each site."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.octree import Octree, neighbour_ranges
from pipeprog_detect.threads import THREADS, mapped

# A quadric has six coefficients: twice as many points leave something to judge it by.
_LEAST_POINTS = 12
# Neighbours of a site that a quadric is fitted to: an even subset where there are more. Twice the 500 that a thinned
# cloud of scale / 7 holds within a thick surface; the fit's variance falls no further, and its time is bounded.
_MOST_NEIGHBOURS = 1024
# Neighbours that spread across their plane by less than this share of the noise are flat: the noise alone spreads them
# by 1, a curvature that matters by more; averaged cells scatter less than single points do.
_FLAT = 0.7
# A quadric that fewer of a patch's points agree with is one of several surfaces: it tells no noise.
_ONE_SURFACE = 0.8
# Root of the Tukey-weighted mean square of Gaussian residuals, cut at four sigma, in sigmas.
_TUKEY_SHRINKAGE = 0.873
# Powers of x and y of a quadric's terms 1, x, y, xx, xy, yy.
_POWERS = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]])


@dataclass(frozen=True)
class Surfaces:
    """Shape of the cloud around S sites within `scale` [m]; rows with count 0 have too few points.

    centres (S, 3): the mean of the neighbours; feet (S, 3): the fitted surface at the site; normals (S, 3), sign
    arbitrary; directions (S, 3): of least curvature; curvature (S,) [1/m]: the greater principal one, positive where
    the surface bends towards -normal; second (S,): the other; sigma (S,): its standard deviation by the noise;
    rms (S,) [m] of the residuals and inliers (S,): their share; count (S,) of the neighbours; spread (S, 3): standard
    deviations [m] of the neighbours along their principal directions, ascending; line (S, 3): the direction of
    greatest spread.
    """

    scale: float
    sites: FloatArray
    centres: FloatArray
    feet: FloatArray
    normals: FloatArray
    directions: FloatArray
    curvature: FloatArray
    second: FloatArray
    sigma: FloatArray
    rms: FloatArray
    inliers: FloatArray
    spread: FloatArray
    line: FloatArray
    count: IntArray


def surfaces(tree: Octree, sites: Octree, scale: float, sigma: float) -> Surfaces:
    """Fit a quadric to the points of `tree` within `scale` [m] of each site; `sigma` [m] is the cloud's noise.

    The residuals are weighted by Tukey's function at the known noise, so a second surface near by drops out.
    Sites whose neighbours are flat within the noise get curvature 0 without a quadric.
    """
    level = tree.level_of(scale)
    if tree.quantum * 2.0**level < scale:
        level += 1
    cells = tree.cells(level)
    own_cells = sites.keys >> (3 * level)

    def fit(part: slice) -> tuple[FloatArray, IntArray]:
        return _fit_sites(
            sites.points[part], own_cells[part], tree.points, cells.keys, cells.starts, level, scale, sigma
        )

    bounds = np.linspace(0, len(sites.points), THREADS + 1).astype(int)
    parts = mapped(fit, [slice(first, last) for first, last in pairwise(bounds)])
    table, count = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Surfaces(
        scale,
        sites.points,
        table[:, 0:3],
        table[:, 3:6],
        table[:, 6:9],
        table[:, 9:12],
        table[:, 12],
        table[:, 13],
        table[:, 14],
        table[:, 15],
        table[:, 16],
        table[:, 17:20],
        table[:, 20:23],
        count,
    )


def estimate_noise(tree: Octree, most_cells: int = 20000) -> float:
    """Standard deviation [m] of the points across the surfaces: the median over small patches of a quadric's residual.

    The patches are cells of 3 cm, or larger where the cloud is too thin to fill them; edges and double surfaces are
    few and only lengthen the upper tail. Where no patch tells, it is what the tree rounds the points to, and no less.
    """
    for level in range(tree.level_of(0.03), tree.level_of(1.0) + 1):
        cells = tree.cells(level)
        full = np.flatnonzero(cells.counts >= 2 * _LEAST_POINTS)
        if len(full) >= 20 and cells.counts[full].sum() > 0.2 * len(tree.points):
            break
    else:
        return tree.quantum
    chosen: IntArray = full[:: max(1, len(full) // most_cells)]
    residual = _patch_residuals(tree.points, cells.starts[chosen], cells.starts[chosen + 1], cells.size)
    clean = residual[residual > 0]
    return max(float(np.median(clean)) / _TUKEY_SHRINKAGE, tree.quantum) if len(clean) else tree.quantum


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _principal(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, standard deviations ascending, and principal directions as rows (normal first)."""
    count = len(points)
    mean = np.zeros(3)
    for i in range(count):
        for k in range(3):
            mean[k] += points[i, k]
    mean /= count
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(count):
        x, y, z = points[i, 0] - mean[0], points[i, 1] - mean[1], points[i, 2] - mean[2]
        xx, xy, xz, yy, yz, zz = xx + x * x, xy + x * y, xz + x * z, yy + y * y, yz + y * z, zz + z * z
    scatter = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    values, vectors = np.linalg.eigh(scatter / count)
    return mean, np.sqrt(np.maximum(values, 0.0)), np.ascontiguousarray(vectors.T)


@njit(cache=True, nogil=True)
def _solve_quadric(
    points: FloatArray, origin: FloatArray, frame: FloatArray, scale: float, sigma: float, rounds: int
) -> tuple[FloatArray, float, float, float]:
    """Weighted z = q . (1, x, y, xx, xy, yy) in units of scale; returns q, rms [m], inlier share, variance of xx."""
    count = len(points)
    local = np.empty((3, count))
    for i in range(count):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        for k in range(3):
            local[k, i] = (x * frame[k, 0] + y * frame[k, 1] + z * frame[k, 2]) / scale
    q: FloatArray = np.zeros(6)
    rms, share, variance = 0.0, 0.0, 0.0
    for turn in range(rounds):
        # Four sigma after a first plain round; wide at first, since the plane is not yet the surface.
        reach = 4.0 * sigma * (2.0 if turn == 1 else 1.0) / scale if turn > 0 else np.inf
        total, square, moments, right = _quadric_sums(local, q, reach)
        if total < 8:
            return q, 0.0, 0.0, 0.0
        normal = np.empty((6, 6))
        for a in range(6):
            for b in range(6):
                normal[a, b] = moments[_POWERS[a, 0] + _POWERS[b, 0], _POWERS[a, 1] + _POWERS[b, 1]]
            normal[a, a] += 1e-9 * total
        inverse = np.linalg.inv(normal)
        q = np.dot(inverse, right)
        rms = scale * np.sqrt(square / max(moments[0, 0], 1e-12)) if turn > 0 else 0.0
        share = total / count
        variance = max(inverse[3, 3], inverse[5, 5])
    return q, rms, share, variance


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _quadric_sums(local: FloatArray, q: FloatArray, reach: float) -> tuple[int, float, FloatArray, FloatArray]:
    """Sums over points (3, N) within `reach` of the quadric q, by Tukey's weights.

    Their number, the weighted squares of their distances, the weighted moments x^a y^b (5, 5) for a + b <= 4, and the
    weighted sums (6,) of z times 1, x, y, xx, xy, yy.
    """
    total, square = 0, 0.0
    m00 = m10 = m01 = m20 = m11 = m02 = m30 = m21 = m12 = m03 = m40 = m31 = m22 = m13 = m04 = 0.0
    r0 = r1 = r2 = r3 = r4 = r5 = 0.0
    for i in range(local.shape[1]):
        x, y, z = local[0, i], local[1, i], local[2, i]
        xx, xy, yy = x * x, x * y, y * y
        d = z - q[0] - q[1] * x - q[2] * y - q[3] * xx - q[4] * xy - q[5] * yy
        t = d / reach
        inner = max(1.0 - t * t, 0.0)
        w = inner * inner
        total += 1 if inner > 0.0 else 0
        square += w * d * d
        m00, m10, m01, m20, m11, m02 = m00 + w, m10 + w * x, m01 + w * y, m20 + w * xx, m11 + w * xy, m02 + w * yy
        m30, m21, m12, m03 = m30 + w * xx * x, m21 + w * xx * y, m12 + w * x * yy, m03 + w * yy * y
        m40, m31, m22 = m40 + w * xx * xx, m31 + w * xx * xy, m22 + w * xx * yy
        m13, m04 = m13 + w * xy * yy, m04 + w * yy * yy
        v = w * z
        r0, r1, r2, r3, r4, r5 = r0 + v, r1 + v * x, r2 + v * y, r3 + v * xx, r4 + v * xy, r5 + v * yy
    moments = np.zeros((5, 5))
    moments[0, 0], moments[1, 0], moments[0, 1] = m00, m10, m01
    moments[2, 0], moments[1, 1], moments[0, 2] = m20, m11, m02
    moments[3, 0], moments[2, 1], moments[1, 2], moments[0, 3] = m30, m21, m12, m03
    moments[4, 0], moments[3, 1], moments[2, 2], moments[1, 3], moments[0, 4] = m40, m31, m22, m13, m04
    return total, square, moments, np.array([r0, r1, r2, r3, r4, r5])


@njit(cache=True, nogil=True)
def _fit_sites(
    sites: FloatArray,
    site_cells: IntArray,
    points: FloatArray,
    cell_keys: IntArray,
    cell_starts: IntArray,
    level: int,
    scale: float,
    sigma: float,
) -> tuple[FloatArray, IntArray]:
    table = np.zeros((len(sites), 23))
    count = np.zeros(len(sites), np.int64)
    ranges = np.zeros((27, 2), np.int64)
    cells, last = 0, -1
    buffer = np.empty((_MOST_NEIGHBOURS, 3))
    for s in range(len(sites)):
        if site_cells[s] != last:
            last = site_cells[s]
            cells = neighbour_ranges(last, cell_keys, cell_starts, level, ranges)
        found, kept = _neighbours(points, ranges[:cells], sites[s], scale, buffer)
        if found < _LEAST_POINTS:
            continue
        near = buffer[:kept]
        mean, spread, axes = _principal(near)
        out = table[s]
        out[0:3] = mean
        out[17:20] = spread
        out[20:23] = axes[2]
        out[6:9] = axes[0]
        out[9:12] = axes[2]
        out[3:6] = mean
        out[15] = spread[0]
        out[16] = 1.0
        count[s] = found
        if spread[0] >= _FLAT * sigma:
            _fit_quadric(near, sites[s], axes, scale, sigma, out)
    return table, count


@njit(cache=True, nogil=True)
def _neighbours(
    points: FloatArray, ranges: IntArray, site: FloatArray, scale: float, buffer: FloatArray
) -> tuple[int, int]:
    """Copies the points within `scale` [m] of a site to the buffer, an even subset where it is too short.

    Returns the number of points, and of those that were copied.
    """
    # A plain constant has a type of its own, for which the function would be compiled once more; so have rounds below.
    found = _copy_neighbours(points, ranges, site, scale, buffer, np.int64(1))
    if found <= len(buffer):
        return found, found
    step = -(-found // len(buffer))
    _copy_neighbours(points, ranges, site, scale, buffer, step)
    return found, -(-found // step)


@njit(cache=True, nogil=True)
def _copy_neighbours(
    points: FloatArray, ranges: IntArray, site: FloatArray, scale: float, buffer: FloatArray, step: int
) -> int:
    """Copies every `step`-th point within `scale` [m] while there is room; returns the number of points there."""
    found = 0
    for r in range(len(ranges)):
        for i in range(ranges[r, 0], ranges[r, 1]):
            dx = points[i, 0] - site[0]
            dy = points[i, 1] - site[1]
            dz = points[i, 2] - site[2]
            if dx * dx + dy * dy + dz * dz <= scale * scale:
                row = found // step
                if row < len(buffer) and row * step == found:
                    buffer[row, 0] = points[i, 0]
                    buffer[row, 1] = points[i, 1]
                    buffer[row, 2] = points[i, 2]
                found += 1
    return found


@njit(cache=True, nogil=True)
def _fit_quadric(
    near: FloatArray, site: FloatArray, axes: FloatArray, scale: float, sigma: float, out: FloatArray
) -> None:
    """Writes foot, normal, direction, curvatures, their sigma, rms and inlier share of a site to its row of the table.

    Where too few points agree with a quadric only the last two are written, the share as 0.
    """
    frame = np.empty((3, 3))
    frame[0], frame[1], frame[2] = axes[2], axes[1], axes[0]
    q, rms, share, variance = _solve_quadric(near, site, frame, scale, sigma, np.int64(4))
    out[15] = rms
    out[16] = share
    if share == 0.0:
        return
    # Hessian of the height over the tangent plane, in 1/m.
    hxx, hxy, hyy = 2.0 * q[3] / scale, q[4] / scale, 2.0 * q[5] / scale
    half = 0.5 * np.sqrt((hxx - hyy) ** 2 + 4.0 * hxy * hxy)
    mid = 0.5 * (hxx + hyy)
    k1, k2 = mid + half, mid - half
    angle = 0.5 * np.arctan2(2.0 * hxy, hxx - hyy)
    if abs(k2) > abs(k1):
        k1, k2 = k2, k1
        angle += 0.5 * np.pi
    slope = np.sqrt(1.0 + q[1] * q[1] + q[2] * q[2])
    normal = (frame[2] - q[1] * frame[0] - q[2] * frame[1]) / slope
    direction = -np.sin(angle) * frame[0] + np.cos(angle) * frame[1]
    direction = direction - (direction @ normal) * normal
    out[3:6] = site + q[0] * scale * frame[2]
    out[6:9] = normal
    out[9:12] = direction / np.sqrt(direction @ direction)
    out[12] = -k1 / slope**3
    out[13] = -k2 / slope**3
    out[14] = 2.0 * np.sqrt(variance) * sigma / (scale * scale)


@njit(cache=True, nogil=True)
def _patch_residuals(points: FloatArray, first: IntArray, last: IntArray, scale: float) -> FloatArray:
    out = np.zeros(len(first))
    for c in range(len(first)):
        near = points[first[c] : last[c]]
        mean, spread, axes = _principal(near)
        # A sliver holds no quadric.
        if spread[1] < 0.1 * scale:
            continue
        frame = np.empty((3, 3))
        frame[0], frame[1], frame[2] = axes[2], axes[1], axes[0]
        wide = max(spread[0], 1e-6)
        _, rms, share, _ = _solve_quadric(near, mean, frame, scale, wide, np.int64(3))
        if share > _ONE_SURFACE:
            out[c] = rms * np.sqrt(len(near) / max(len(near) - 6.0, 1.0))
    return out
