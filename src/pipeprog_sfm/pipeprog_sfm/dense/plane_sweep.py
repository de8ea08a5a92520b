# SPDX-License-Identifier: Apache-2.0
"""Dense depth to a pixel's accuracy: plane sweep over all neighbours, census cost, semi-global matching.

Collins, "A space-sweep approach to true multi-image matching", 1996; Zabih and Woodfill, "Non-parametric local
transforms for computing visual correspondence", 1994; Hirschmueller, "Stereo processing by semiglobal matching and
mutual information", 2008. The cost is taken in the reference view straight from the poses, so no pair is rectified and
baselines of any direction share one volume. From coarse to fine, each pixel tries what a sweep at half of the
resolution has found around it, as do Rothermel et al., "SURE: photogrammetric surface reconstruction from imagery",
2012: an eighth of the hypotheses.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_sfm.dense.row_mapping import RowMapping, at_row

RADIUS = 2  # of the census window, 24 comparisons: larger windows flatten pipes and fatten their edges
PENALTY_SMALL = 6  # for a step of one hypothesis, of 48 = two views that differ in all comparisons
PENALTY_LARGE = 48  # for a jump
MAX_HYPOTHESES = 256  # over the range; beyond, steps get wider than a pixel
COARSE_HYPOTHESES = MAX_HYPOTHESES // 2  # of a sweep whose pixels are twice as wide
# Pixels of the coarse depth around one, whose depths are tried: by RADIUS its windows widen what is in front.
AROUND = RADIUS + 1
# Hypotheses beyond those: what is too thin for the coarse sweep stands before what is seen behind it by 3 % of the
# depth at most, as a pipe on its clamps.
MARGIN = 8
APART = 2  # unused cells between the hypotheses of two pixels: no path comes from them
_BARRED = np.uint16(30000)  # their path cost, above all others: those are below 4 * PENALTY_LARGE
OVERSAMPLING = 2  # of the neighbours, so that a rounded position is at most a quarter of a pixel off
_BITS = (2 * RADIUS + 1) ** 2 - 1
_UNSEEN = _BITS // 2  # cost of a view that does not see the point: no opinion


class Hypotheses(NamedTuple):
    """The inverse depths that each pixel tries: the d-th of pixel (u, v) is least + step * (starts[v, u] + d).

    Attributes:
        least, step: float32.
        starts: (h, w) int32.
        offsets: (h * w + 1,) int64, where those of a pixel begin in an array of all, with APART cells between them.
    """

    least: np.float32
    step: np.float32
    starts: NDArray[np.int32]
    offsets: NDArray[np.int64]


def sweep(
    codes: NDArray[np.uint32],
    others: NDArray[np.uint32],
    homographies: NDArray[np.float64],
    epipoles: NDArray[np.float64],
    inverse_range: tuple[float, float],
    rows: RowMapping | None = None,
    coarse: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """(h, w) inverse depth of the reference image, NaN at the ends of the range.

    `codes` (h, w) are its `census`, `others` (N, h2, w2) those of its neighbours, images of OVERSAMPLING times the
    resolution, low-passed alike; a pixel (u, v) of inverse depth i lies at the homogeneous pixel
    homographies[n] @ (u, v, 1) + i * epipoles[n] of them; with rolling `rows` that is so at the stamps, and inverse
    depth is on the optical axis of each row's own pose. `coarse` (h / 2, w / 2) is what a sweep at half of the
    resolution has found; without it the whole range is tried, in steps for one whose pixels are twice as wide.
    """
    count = _count(codes.shape, homographies, epipoles, inverse_range)
    if coarse is None:
        count = min(count, COARSE_HYPOTHESES)
        lowest, highest = np.zeros(codes.shape, np.int32), np.full(codes.shape, count - 1, np.int32)
    least, most = inverse_range
    step = (most - least) / (count - 1)
    if coarse is not None:
        lowest, highest = _about((coarse - least) / step, codes.shape, count)
    sizes = (highest - lowest).ravel().astype(np.int64) + 1
    offsets = np.concatenate([[0], np.cumsum(sizes + APART)])
    tried = Hypotheses(np.float32(least), np.float32(step), lowest, offsets)
    views = codes, others, homographies.astype(np.float32), epipoles.astype(np.float32)
    costs = _cost_volume(*views, tried, int(sizes.max()), rows)
    index = _best(_aggregate(costs, tried, PENALTY_SMALL, PENALTY_LARGE), tried, count)
    return (least + step * index).astype(np.float32)


def _count(
    shape: tuple[int, ...],
    homographies: NDArray[np.float64],
    epipoles: NDArray[np.float64],
    inverse_range: tuple[float, float],
) -> int:
    """Number of hypotheses in steps of a pixel."""
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    longest = 0.0  # track of a pixel over the range
    for homography, epipole in zip(homographies, epipoles, strict=True):
        ends = [homography @ corners + inverse * epipole[:, None] for inverse in inverse_range]
        if min(end[2].min() for end in ends) > 0:
            track = ends[1][:2] / ends[1][2] - ends[0][:2] / ends[0][2]
            longest = max(longest, float(np.linalg.norm(track, axis=0).max()) / OVERSAMPLING)
    return int(np.clip(np.ceil(longest) + 1, 8, MAX_HYPOTHESES))


def _about(
    coarse: NDArray[np.float32], shape: tuple[int, ...], count: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last hypothesis of each pixel (h, w): those `coarse` has around it, and MARGIN; or all.

    `coarse` counts hypotheses.
    """
    kernel = np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8)
    known = np.isfinite(coarse)
    low = cv2.erode(np.where(known, coarse, np.float32(count)).astype(np.float32), kernel)
    high = cv2.dilate(np.where(known, coarse, np.float32(-1.0)).astype(np.float32), kernel)
    nothing = high < low
    low = np.where(nothing, 0.0, np.maximum(np.floor(low) - MARGIN, 0.0))
    high = np.where(nothing, count - 1.0, np.minimum(np.ceil(high) + MARGIN, count - 1.0))
    rows, columns = (np.minimum(np.arange(n) // 2, m - 1) for n, m in zip(shape, coarse.shape, strict=True))
    return low.astype(np.int32)[rows[:, None], columns], high.astype(np.int32)[rows[:, None], columns]


@njit(cache=True, nogil=True)
def census(image, stride):  # type: ignore[no-untyped-def]
    """Bit string of a pixel: which pixels around it, `stride` apart, are darker. 0 at the border: unknown."""
    height, width = image.shape
    margin = RADIUS * stride
    out = np.zeros((height, width), np.uint32)
    for v in range(margin, height - margin):
        for u in range(margin, width - margin):
            bits = 1  # a leading one tells the code of a flat patch from unknown
            for i in range(-RADIUS, RADIUS + 1):
                for j in range(-RADIUS, RADIUS + 1):
                    if i != 0 or j != 0:
                        bits = 2 * bits + int(image[v + i * stride, u + j * stride] < image[v, u])
            out[v, u] = bits
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _cost_volume(census, others, homographies, epipoles, tried, most, rows):  # type: ignore[no-untyped-def]
    """(offsets[-1],) uint8: Hamming distances of the two best views, summed: occlusion on one side does not matter.

    A pixel tries `most` hypotheses at most. Three loops over them, because the compiler makes vector code of the first
    and the last alone: of a store beside reads at computed places it cannot tell that they do not overlap. Without
    rolling `rows` (None) their branch is not compiled.
    """
    height, width = census.shape
    number, other_height, other_width = others.shape
    codes = others.reshape(number, other_height * other_width)
    costs = np.empty(tried.offsets[-1], np.uint8)
    step = tried.step
    for v in range(height):
        room = np.empty(most, np.int32), np.empty(most, np.uint32), np.empty(most, np.int32), np.empty(most, np.int32)
        turned, moved = np.empty((2, 3), np.float32)
        for u in range(width):
            begin = tried.offsets[v * width + u]
            count = tried.offsets[v * width + u + 1] - begin - APART
            places, seen, first, second = room[0][:count], room[1][:count], room[2][:count], room[3][:count]
            least = np.float32(tried.least + step * np.float32(tried.starts[v, u]))
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
            cost = costs[begin : begin + count]
            for d in range(count):
                cost[d] = first[d] + second[d]
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


@njit(cache=True, nogil=True)
def _aggregate(costs, tried, penalty_small, penalty_large):  # type: ignore[no-untyped-def]
    """(2, offsets[-1]) uint16: path costs from above (left, upper left, up, upper right) and, mirrored, from below."""
    starts, offsets = tried.starts, tried.offsets
    height, width = starts.shape
    sums = np.empty((2, len(costs)), np.uint16)
    longest = 0  # row of hypotheses
    for v in range(height):
        longest = max(longest, offsets[(v + 1) * width] - offsets[v * width])
    for half in range(2):
        # Path costs of two rows, four directions each, and their least ones; the rows take turns.
        paths = np.full(8 * longest, _BARRED, np.uint16)
        leasts = np.zeros((2, 4, width), np.uint16)
        for row in range(height):
            v = row if half == 0 else height - 1 - row
            above = v if row == 0 else (v - 1 if half == 0 else v + 1)
            now, last = row % 2, 1 - row % 2
            for column in range(width):
                u = column if half == 0 else width - 1 - column
                pixel = v * width + u
                size = offsets[pixel + 1] - offsets[pixel] - APART
                for k in range(4):
                    other_row, turn = (v, now) if k == 0 else (above, last)
                    source = max(column - 1, 0) if k == 0 else min(max(column + k - 2, 0), width - 1)
                    w = source if half == 0 else width - 1 - source
                    other = other_row * width + w
                    is_first = (column if k == 0 else row) == 0
                    known = 0 if is_first else offsets[other + 1] - offsets[other] - APART
                    shift = np.int64(starts[v, u]) - np.int64(starts[other_row, w])
                    there = (4 * turn + k) * longest + 1 + offsets[other] - offsets[other_row * width]
                    here = (4 * now + k) * longest + 1 + offsets[pixel] - offsets[v * width]
                    leasts[now, k, u] = _extend(
                        costs, offsets[pixel], size, paths, there, known, shift, leasts[turn, k, w], here,
                        sums[half], k == 0, penalty_small, penalty_large,
                    )  # fmt: skip
    return sums


# Indices are unsigned, since the compiler makes no vector code of those that may count from the end.
@njit(inline="always")
def _extend(  # type: ignore[no-untyped-def]
    costs, begin, size, paths, there, known, shift, least, here, sums, is_first, penalty_small, penalty_large,
):  # fmt: skip
    """Equation 13 of Hirschmueller: the path costs of a pixel from those of the pixel before; returns the least one.

    The pixel has `size` hypotheses from `begin` of the costs and the sums on, and its path costs go to paths[here:].
    The pixel before has `known` path costs from `there` on, the least one of which is `least`; number `shift` of them
    is of this pixel's first hypothesis. The sums are set if this `is_first` of them, else added to.
    """
    small, large = np.uint16(penalty_small), np.uint16(penalty_large)
    jump = np.uint16(least + large)
    low = min(max(-shift, 0), size)
    high = max(min(known - shift, size), low)
    if high - low < size:
        for d in range(np.uintp(size)):
            paths[np.uintp(here) + d] = np.uint16(costs[np.uintp(begin) + d] + large)
    same, cost, path = np.uintp(there + low + shift), np.uintp(begin + low), np.uintp(here + low)
    for d in range(np.uintp(high - low)):
        step = np.uint16(min(paths[same + d - np.uintp(1)], paths[same + d + np.uintp(1)]) + small)
        paths[path + d] = np.uint16(np.uint16(costs[cost + d]) + min(min(paths[same + d], step), jump) - least)
    paths[np.uintp(here - 1)] = paths[np.uintp(here + size)] = _BARRED
    path, total = np.uintp(here), np.uintp(begin)
    lowest = np.uint16(65535)
    if is_first:
        for d in range(np.uintp(size)):
            value = paths[path + d]
            sums[total + d] = value
            lowest = min(lowest, value)
    else:
        for d in range(np.uintp(size)):
            value = paths[path + d]
            sums[total + d] += value
            lowest = min(lowest, value)
    return lowest


@njit(cache=True, nogil=True)
def _best(sums, tried, count):  # type: ignore[no-untyped-def]
    """(h, w) float32 index of the least sum, refined between its two neighbours; NaN at either end of the range."""
    height, width = tried.starts.shape
    out = np.full((height, width), np.nan, np.float32)
    for v in range(height):
        for u in range(width):
            begin, end = tried.offsets[v * width + u], tried.offsets[v * width + u + 1] - APART
            above, below = sums[0, begin:end], sums[1, begin:end]
            # The least sum first and then its place: the compiler makes vector code of a loop without places.
            least = np.int32(1 << 30)
            for d in range(end - begin):
                least = min(least, np.int32(np.int32(above[d]) + np.int32(below[d])))
            best = 0
            while np.int32(above[best]) + np.int32(below[best]) != least:
                best += 1
            index = tried.starts[v, u] + best
            if not 0 < index < count - 1:
                continue
            out[v, u] = index
            if 0 < best < end - begin - 1:
                before = np.int32(above[best - 1]) + np.int32(below[best - 1])
                after = np.int32(above[best + 1]) + np.int32(below[best + 1])
                flank = max(before, after) - least
                out[v, u] += 0.5 * (before - after) / flank if flank > 0 else 0.0
    return out
