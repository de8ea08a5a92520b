# SPDX-License-Identifier: Apache-2.0
"""Dense depth to a pixel's accuracy: plane sweep over all neighbours, census cost, semi-global matching.

Collins, "A space-sweep approach to true multi-image matching", 1996; Zabih and Woodfill, "Non-parametric local
transforms for computing visual correspondence", 1994; Hirschmueller, "Stereo processing by semiglobal matching and
mutual information", 2008. The cost is taken in the reference view straight from the poses, so no pair is rectified and
baselines of any direction share one volume.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pipeprog_sfm.dense.row_mapping import RowMapping, at_row

RADIUS = 2  # of the census window, 24 comparisons: larger windows flatten pipes and fatten their edges
PENALTY_SMALL = 6  # for a step of one hypothesis, of 48 = two views that differ in all comparisons
PENALTY_LARGE = 48  # for a jump
MAX_HYPOTHESES = 256  # bounds the memory, 5 bytes a pixel and hypothesis; beyond, steps get wider than a pixel
OVERSAMPLING = 2  # of the neighbours, so that a rounded position is at most a quarter of a pixel off
_BITS = (2 * RADIUS + 1) ** 2 - 1
_UNSEEN = _BITS // 2  # cost of a view that does not see the point: no opinion


def sweep(
    codes: NDArray[np.uint32],
    others: NDArray[np.uint32],
    homographies: NDArray[np.float64],
    epipoles: NDArray[np.float64],
    inverse_range: tuple[float, float],
    rows: RowMapping | None = None,
) -> NDArray[np.float32]:
    """(h, w) inverse depth of the reference image, NaN at the ends of the range.

    `codes` (h, w) are its `census`, `others` (N, h2, w2) those of its neighbours, images of OVERSAMPLING times the
    resolution, low-passed alike; a pixel (u, v) of inverse depth i lies at the homogeneous pixel
    homographies[n] @ (u, v, 1) + i * epipoles[n] of them; with rolling `rows` that is so at the stamps, and inverse
    depth is on the optical axis of each row's own pose.
    """
    height, width = codes.shape
    least, most = inverse_range
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    longest = 0.0  # track of a pixel over the range
    for homography, epipole in zip(homographies, epipoles, strict=True):
        ends = [homography @ corners + inverse * epipole[:, None] for inverse in (least, most)]
        if min(end[2].min() for end in ends) > 0:
            track = ends[1][:2] / ends[1][2] - ends[0][:2] / ends[0][2]
            longest = max(longest, float(np.linalg.norm(track, axis=0).max()) / OVERSAMPLING)
    count = int(np.clip(np.ceil(longest) + 1, 8, MAX_HYPOTHESES))
    step = (most - least) / (count - 1)
    costs = _cost_volume(
        codes,
        others,
        homographies.astype(np.float32),
        epipoles.astype(np.float32),
        np.float32(least),
        np.float32(step),
        count,
        rows,
    )
    index = _best(_aggregate(costs, PENALTY_SMALL, PENALTY_LARGE))
    return (least + step * index).astype(np.float32)


@njit(cache=True, nogil=True, parallel=True)
def census(image, stride):  # type: ignore[no-untyped-def]
    """Bit string of a pixel: which pixels around it, `stride` apart, are darker. 0 at the border: unknown."""
    height, width = image.shape
    margin = RADIUS * stride
    out = np.zeros((height, width), np.uint32)
    for v in prange(margin, height - margin):
        for u in range(margin, width - margin):
            bits = 1  # a leading one tells the code of a flat patch from unknown
            for i in range(-RADIUS, RADIUS + 1):
                for j in range(-RADIUS, RADIUS + 1):
                    if i != 0 or j != 0:
                        bits = 2 * bits + int(image[v + i * stride, u + j * stride] < image[v, u])
            out[v, u] = bits
    return out


@njit(cache=True, nogil=True, parallel=True, fastmath=True, error_model="numpy")
def _cost_volume(census, others, homographies, epipoles, least, step, count, rows):  # type: ignore[no-untyped-def]
    """(h, w, count) uint8: Hamming distances of the two best views, summed: occlusion on one side does not matter.

    Three loops over the hypotheses, because the compiler makes vector code of the first and the last alone: of a store
    beside reads at computed places it cannot tell that they do not overlap. Without rolling `rows` (None) their branch
    is not compiled.
    """
    height, width = census.shape
    number, other_height, other_width = others.shape
    codes = others.reshape(number, other_height * other_width)
    costs = np.empty((height, width, count), np.uint8)
    for v in prange(height):
        places = np.empty(count, np.int32)
        seen = np.empty(count, np.uint32)
        first = np.empty(count, np.int32)
        second = np.empty(count, np.int32)
        turned, moved = np.empty((2, 3), np.float32)
        for u in range(width):
            first[:] = 255
            second[:] = 255
            for n in range(number):
                h, e = homographies[n], epipoles[n]
                if rows is None:
                    x = np.float32(h[0, 0] * u + h[0, 1] * v + h[0, 2] + e[0] * least)
                    y = np.float32(h[1, 0] * u + h[1, 1] * v + h[1, 2] + e[1] * least)
                    z = np.float32(h[2, 0] * u + h[2, 1] * v + h[2, 2] + e[2] * least)
                    size = np.int32(other_width), np.int32(other_height)
                    _project((x, y, z), (e[0] * step, e[1] * step, e[2] * step), size, places)
                else:
                    at_row(h, e, rows, n, u, v, turned, moved)
                    _project_rolled(turned, moved, (least, step), rows, n, places)
                for d in range(count):
                    seen[d] = codes[n, np.uint32(places[d])]
                _compare(census[v, u], seen, first, second)
            if number == 1:
                second[:] = first
            for d in range(count):
                costs[v, u, d] = first[d] + second[d]
    return costs


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _project(start, step, size, places):  # type: ignore[no-untyped-def]
    """Index of the pixel of each hypothesis in an image of (width, height); 0, an unknown code, outside.

    Hypothesis d lies at the homogeneous pixel start + d * step.
    """
    x, y, z = start
    dx, dy, dz = step
    width, height = size
    for d in range(len(places)):
        k = np.float32(d)
        inverse = np.float32(1.0) / (z + dz * k)
        column = np.int32((x + dx * k) * inverse + np.float32(0.5))
        row = np.int32((y + dy * k) * inverse + np.float32(0.5))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        places[d] = np.int32(np.int32(row * width) + column) if inside else np.int32(0)


@njit(cache=True, nogil=True, inline="always", fastmath=True, error_model="numpy")
def _project_rolled(turned, moved, inverse, rows, n, places):  # type: ignore[no-untyped-def]
    """`_project` to neighbour n with rolling rows; `inverse`: of hypothesis 0, and from one to the next.

    `turned` and `moved` (3,) are from `at_row`. The time of the neighbour's row, f + l y / z, multiplies what turns and
    moves the point; times z, each coordinate is a square polynomial of the hypothesis, without a division. The lens's
    distortion of the row and the square of the turn are left to the refinement: 0.3 px at most.
    """
    a, shift = rows.other_turned[n, 0], rows.other_moved[n]
    first, later = rows.other_clocks[n]
    height, width = np.int32(rows.other_times.shape[1]), np.int32(rows.other_times.shape[2])
    least, step = inverse
    x, y, z = turned[0] + least * moved[0], turned[1] + least * moved[1], turned[2] + least * moved[2]
    dx, dy, dz = step * moved[0], step * moved[1], step * moved[2]
    time, time_step = first * z + later * y, first * dz + later * dy
    x0, x1, x2 = _rolled_polynomial(x, dx, z, dz, time, time_step, a[0], (x, y, z), (dx, dy, dz), shift[0], inverse)
    y0, y1, y2 = _rolled_polynomial(y, dy, z, dz, time, time_step, a[1], (x, y, z), (dx, dy, dz), shift[1], inverse)
    z0, z1, z2 = _rolled_polynomial(z, dz, z, dz, time, time_step, a[2], (x, y, z), (dx, dy, dz), shift[2], inverse)
    for d in range(len(places)):
        k = np.float32(d)
        scale = np.float32(1.0) / (z0 + k * (z1 + k * z2))
        column = np.int32((x0 + k * (x1 + k * x2)) * scale + np.float32(0.5))
        row = np.int32((y0 + k * (y1 + k * y2)) * scale + np.float32(0.5))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        places[d] = np.int32(np.int32(row * width) + column) if inside else np.int32(0)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _rolled_polynomial(c, dc, z, dz, time, time_step, a, point, step, shift, inverse):  # type: ignore[no-untyped-def]
    """Coefficients of one coordinate of a homogeneous pixel, times z: c z + t (a p + i shift).

    All of c, z, t, p and i are linear in the hypothesis; each is given at the first one, and its step.
    """
    turn = a[0] * point[0] + a[1] * point[1] + a[2] * point[2] + inverse[0] * shift
    turn_step = a[0] * step[0] + a[1] * step[1] + a[2] * step[2] + inverse[1] * shift
    return (
        c * z + time * turn,
        c * dz + dc * z + time * turn_step + time_step * turn,
        dc * dz + time_step * turn_step,
    )


@njit(cache=True, nogil=True)
def _compare(code, seen, first, second):  # type: ignore[no-untyped-def]
    """Takes the Hamming distances of `code` to the codes seen into the two least ones of each hypothesis.

    Numba widens integers to 64 bits: the casts keep twice as many in a vector. Bits are counted in parallel, by pairs,
    fours and eights (Warren, Hacker's Delight, 2012, 5-1).
    """
    for d in range(len(seen)):
        bits = np.uint32(code ^ seen[d])
        bits = np.uint32(bits - np.uint32(np.uint32(bits >> np.uint32(1)) & np.uint32(0x55555555)))
        pairs = np.uint32(np.uint32(bits >> np.uint32(2)) & np.uint32(0x33333333))
        bits = np.uint32(np.uint32(bits & np.uint32(0x33333333)) + pairs)
        bits = np.uint32(np.uint32(bits + np.uint32(bits >> np.uint32(4))) & np.uint32(0x0F0F0F0F))
        bits = np.uint32(np.uint32(bits * np.uint32(0x01010101)) >> np.uint32(24))
        cost = np.int32(bits) if seen[d] != 0 else np.int32(_UNSEEN)
        least = first[d]
        second[d] = min(second[d], max(least, cost))
        first[d] = min(least, cost)


@njit(cache=True, nogil=True, parallel=True)
def _aggregate(costs, penalty_small, penalty_large):  # type: ignore[no-untyped-def]
    """(2, h, w, D) uint16: path costs from above (left, upper left, up, upper right) and, mirrored, from below."""
    height, width, count = costs.shape
    sums = np.empty((2, height, width, count), np.uint16)
    for half in prange(2):
        above = np.zeros((3, width + 2, count), np.uint16)
        here = np.zeros((3, width + 2, count), np.uint16)
        above_least = np.zeros((3, width + 2), np.uint16)
        here_least = np.zeros((3, width + 2), np.uint16)
        left = np.zeros(count, np.uint16)
        path = np.zeros(count, np.uint16)
        for row in range(height):
            v = row if half == 0 else height - 1 - row
            left[:] = 0
            left_least = np.uint16(0)
            for column in range(width):
                u = column if half == 0 else width - 1 - column
                cost = costs[v, u]
                total = sums[half, v, u]
                _extend(cost, left, left_least, path, penalty_small, penalty_large)
                least = np.uint16(65535)
                for d in range(count):
                    value = path[d]
                    left[d] = value
                    total[d] = value
                    least = min(least, value)
                left_least = least
                for k in range(3):
                    source = column + k  # the padded columns of upper left, up and upper right
                    out = here[k, column + 1]
                    _extend(cost, above[k, source], above_least[k, source], out, penalty_small, penalty_large)
                    least = np.uint16(65535)
                    for d in range(count):
                        value = out[d]
                        total[d] += value
                        least = min(least, value)
                    here_least[k, column + 1] = least
            for k in range(3):
                here[k, 0] = here[k, 1]
                here[k, width + 1] = here[k, width]
                here_least[k, 0] = here_least[k, 1]
                here_least[k, width + 1] = here_least[k, width]
            above, here = here, above
            above_least, here_least = here_least, above_least
    return sums


@njit(inline="always")
def _extend(cost, path, least, out, penalty_small, penalty_large):  # type: ignore[no-untyped-def]
    """Equation 13 of Hirschmueller: the path cost of a pixel from that of the pixel before."""
    last = len(cost) - 1
    small = np.uint16(penalty_small)
    jump = np.uint16(least + np.uint16(penalty_large))
    out[0] = np.uint16(cost[0] + min(min(path[0], np.uint16(path[1] + small)), jump) - least)
    for d in range(1, last):
        step = np.uint16(min(path[d - 1], path[d + 1]) + small)
        out[d] = np.uint16(np.uint16(cost[d]) + min(min(path[d], step), jump) - least)
    out[last] = np.uint16(cost[last] + min(min(path[last], np.uint16(path[last - 1] + small)), jump) - least)


@njit(cache=True, nogil=True, parallel=True)
def _best(sums):  # type: ignore[no-untyped-def]
    """(h, w) float32 index of the least sum, refined between its two neighbours; NaN at either end of the range."""
    _, height, width, count = sums.shape
    out = np.full((height, width), np.nan, np.float32)
    for v in prange(height):
        for u in range(width):
            above, below = sums[0, v, u], sums[1, v, u]
            # The least sum first and then its place: the compiler makes vector code of a loop without places.
            least = np.int32(1 << 30)
            for d in range(count):
                least = min(least, np.int32(np.int32(above[d]) + np.int32(below[d])))
            best = 0
            while np.int32(above[best]) + np.int32(below[best]) != least:
                best += 1
            if 0 < best < count - 1:
                before = np.int32(above[best - 1]) + np.int32(below[best - 1])
                after = np.int32(above[best + 1]) + np.int32(below[best + 1])
                flank = max(before, after) - least
                out[v, u] = best + (0.5 * (before - after) / flank if flank > 0 else 0.0)
    return out
