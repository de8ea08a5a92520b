# SPDX-License-Identifier: Apache-2.0
"""Where a pipe begins and ends along its axis: where points cover its surface, and where it is straight."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.types import Cylinder

# Bins along the axis hold 12 points on average (where 12 are expected, a quarter or fewer come by chance in 0.2 %), are
# 5 mm long at least (ends are found between bins), and at most as long as the radius, or 30 mm if that is more.
_POINTS_PER_BIN = 12.0
_SHORTEST_BIN, _LONGEST_BIN = 0.005, 0.03
# Fewer points than this do not tell where a surface is.
_LEAST_POINTS = 10
# Sectors of 10 deg on the circumference; a bin is seen where its points are in three of them, over 30 deg.
_SECTORS = 36
_LEAST_SECTORS = 3
# A bin is empty under a quarter of the lower quartile of the bins with points: the far end of a pipe has fewer points
# than the near one, and is judged by its like.
_LEAST_SHARE = 0.25
_LOW_QUANTILE = 0.25
# An end lies where the count falls to half of the level beside it: the median of 3 to 8 bins, of half the interval.
_END_LEVEL = 0.5
_FEWEST_END_BINS, _MOST_END_BINS = 3, 8
# Slices in which the section's centre is solved for: 0.3 radii and 5 mm long, 16 points on average, 6 at least (two
# make a line, four judge it), 120 at most, which bounds the time of trying all pairs of them.
_SLICE_RADII, _SLICE_LENGTH = 0.3, 0.005
_POINTS_PER_SLICE = 16
_FEWEST_SLICES, _MOST_SLICES = 6, 120
# A slice is solved for with 8 points, four for each coordinate of its centre; 4 slices judge a line.
_LEAST_SLICE_POINTS = 8
_LEAST_SLICES = 4
# Deviation [m] of a pipe's axis from a line by sagging and by the waviness of clouds, over its whole length; an elbow
# leaves the line by more within a fraction of its radius.
_AXIS_WAVINESS = 3e-3
# A slice agrees with a line within 2.5 standard deviations of its centre (98.8 % of Gaussian noise where one coordinate
# is the worse, 99.8 % where both are alike), the waviness and 2 % of the radius, by which pipes are oval.
_AGREE_SIGMAS = 2.5
_OVAL = 0.02
# A slice beyond the straight ones is clearly bent where it is off the line by 2.5 standard deviations and half of the
# waviness: next to them the line is known better than over the whole length.
_BENT_WAVINESS = 0.5
# Slices of a tee or a clamp may disagree: three in a row at most, between stretches of more than twice as many.
_BRIDGED = 3
# A bend begins within the two slices beyond the last straight one.
_BEND_SLICES = 2
# A long-radius elbow turns about 1.5 diameters, 3 radii: at s beyond its beginning the centre is s^2 / (2 * 3 r) off.
_ELBOW_RADII = 3.0
# Gap between pieces of one pipe: ten radii or 0.3 m are what fittings, clamps and occluders hide.
_GAP_RADII, _GAP = 10.0, 0.3


@dataclass(frozen=True)
class Interval:
    """The stretch low..high [m] of an axis along which the pipe's surface is seen."""

    low: float
    high: float

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.high - self.low


def bin_length(radius: float, points_per_metre: float) -> float:
    """Length [m] of a bin along the axis of a pipe with this radius [m] and these points for each metre."""
    return float(np.clip(_POINTS_PER_BIN / max(points_per_metre, 1.0), _SHORTEST_BIN, max(radius, _LONGEST_BIN)))


def longest_gap(radius: float) -> float:
    """Gap [m] between stretches of surface of a pipe of this radius [m] that a fitting or an occluder explains."""
    return max(_GAP_RADII * radius, _GAP)


def surface_intervals(points: FloatArray, cylinder: Cylinder) -> list[Interval]:
    """Stretches of the axis along which points (N, 3), all near the surface, cover the pipe.

    Positions are metres from cylinder.start along its axis. Ends lie where the occupancy falls to half of the
    interval's own level, between bins by linear interpolation.
    """
    if len(points) < _LEAST_POINTS:
        return []
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    u, v = basis(cylinder.axis)
    sector = ((np.arctan2(offset @ v, offset @ u) + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
    size = bin_length(cylinder.radius, len(points) / max(cylinder.length, 1e-3))
    low = float(along.min()) - size
    place = ((along - low) / size).astype(int)
    bins = int(place.max()) + 2
    count = np.bincount(place, minlength=bins).astype(float)
    grid = np.zeros((bins, _SECTORS), bool)
    grid[place, sector] = True
    # The sectors are counted over three bins, since a thin pipe has 12 points a bin or fewer.
    arc = grid.copy()
    arc[1:] |= grid[:-1]
    arc[:-1] |= grid[1:]
    covered = arc.sum(axis=1) >= _LEAST_SECTORS
    seen = covered & (count > _LEAST_SHARE * np.quantile(count[count > 0], _LOW_QUANTILE))
    intervals: list[Interval] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        intervals.append(Interval(*_ends(count, first, last, low, size)))
    return intervals


def straight_interval(points: FloatArray, cylinder: Cylinder, sigma: float) -> Interval | None:
    """The longest stretch of the axis on which the section's centre stays on one line, as it does not in an elbow.

    `points` (N, 3) are near the surface, with noise `sigma` [m]. In each slice across the axis the offset of the
    section's centre is solved for at the given radius. Of the lines through two such centres the one that most slices
    agree with is taken; it may differ from the cylinder's axis, which the points of an elbow tilt. The interval reaches
    from the first to the last slice that agrees. Returns the extent of all points where fewer than four slices have a
    centre, None where no line is found.
    """
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    u, v = basis(cylinder.axis)
    x, y = offset @ u, offset @ v
    rho = np.hypot(x, y) + 1e-12
    distance = rho - cylinder.radius
    length = float(along.max() - along.min())
    slices = _slice_count(length, cylinder.radius, len(points))
    low = float(along.min())
    size = length / slices
    place = np.clip(((along - low) / size).astype(int), 0, slices - 1)
    cosine, sine = x / rho, y / rho
    shift, error = _slice_shifts(cosine, sine, distance, place, slices, sigma)
    known = np.flatnonzero(np.isfinite(error))
    if len(known) < _LEAST_SLICES:
        return Interval(low, low + length)
    allowed = _AGREE_SIGMAS * error + _AXIS_WAVINESS + _OVAL * cylinder.radius
    centre = np.asarray(low + (np.arange(slices) + 0.5) * size, np.float64)
    line = _best_line(centre[known], shift[known], allowed[known], max(slices // 6, 1) * size)
    if not line.any():
        return None
    members = known[line]
    parts = _contiguous_slices(members, known)
    longest = max(parts, key=len)
    slope, origin = _fit_line(centre[longest], shift[longest], np.asarray(1.0 / error[longest]))
    off = np.linalg.norm(shift - origin - centre[:, None] * slope, axis=1)
    deviation: FloatArray = np.where(off > _AGREE_SIGMAS * error + _BENT_WAVINESS * _AXIS_WAVINESS, off, np.nan)
    edges = low + longest[0] * size, low + (longest[-1] + 1) * size
    return Interval(
        _onset(edges[0], centre[: longest[0]][::-1], deviation[: longest[0]][::-1], cylinder.radius),
        _onset(edges[1], centre[longest[-1] + 1 :], deviation[longest[-1] + 1 :], cylinder.radius),
    )


def _contiguous_slices(members: IntArray, known: IntArray) -> list[IntArray]:
    """The slices `members`, divided where others between them disagree, unless these are at most three, as at a tee.

    `known` are the slices whose centre is known.
    """
    parts: list[IntArray] = [members[:1]]
    for last, following in pairwise(members):
        between = int(((known > last) & (known < following)).sum())
        if between:
            parts.append(np.array([following]))
        else:
            parts[-1] = np.append(parts[-1], following)
    bridged = [parts[0]]
    for part in parts[1:]:
        hole = int(((known > bridged[-1][-1]) & (known < part[0])).sum())
        if hole <= _BRIDGED and min(len(bridged[-1]), len(part)) > 2 * hole + 1:
            bridged[-1] = np.append(bridged[-1], part)
        else:
            bridged.append(part)
    return bridged


def _onset(end: float, centre: FloatArray, deviation: FloatArray, radius: float) -> float:
    """Position [m] along the axis at which an elbow begins next to a straight stretch that ends at `end` [m].

    Given are the slices (S,) beyond that end, the nearest first: their centres along the axis [m] and, NaN where they
    are not clearly bent, their deviation from the line [m]. In a long-radius elbow the section at s beyond the
    beginning is s^2 / (6 r) off the line, so that the first bent slice tells the beginning. `end` where none is bent.
    """
    near = slice(0, _BEND_SLICES)
    if not np.isfinite(deviation[near]).any():
        return end
    first = int(np.flatnonzero(np.isfinite(deviation[near]))[0])
    back = np.sqrt(2.0 * _ELBOW_RADII * radius * deviation[first])
    outward = 1.0 if centre[first] > end else -1.0
    onset = float(centre[first] - outward * back)
    return min(onset, end) if outward > 0 else max(onset, end)


def _fit_line(place: FloatArray, shift: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slope (2,) and value at 0 (2,) of shift (S, 2) over place (S,)."""
    rows = np.stack([place, np.ones_like(place)], axis=1) * weight[:, None]
    solved = np.linalg.lstsq(rows, shift * weight[:, None], rcond=None)[0]
    return solved[0], solved[1]


@njit(cache=True, nogil=True)
def _best_line(place: FloatArray, shift: FloatArray, allowed: FloatArray, apart: float) -> NDArray[np.bool_]:
    """Mask (S,) of the slices that agree with the best line through two centres at least `apart` [m] from each other.

    Every agreeing slice adds 1 to a line's worth, less half of its deviation as a share of what is `allowed` (S,) [m].
    """
    count = len(place)
    best = 0.0
    members = np.zeros(count, np.bool_)
    agree = np.zeros(count, np.bool_)
    for first in range(count):
        for second in range(first + 1, count):
            gap = place[second] - place[first]
            if gap < apart:
                continue
            su, sv = (shift[second, 0] - shift[first, 0]) / gap, (shift[second, 1] - shift[first, 1]) / gap
            worth = 0.0
            for k in range(count):
                du = shift[k, 0] - shift[first, 0] - (place[k] - place[first]) * su
                dv = shift[k, 1] - shift[first, 1] - (place[k] - place[first]) * sv
                miss = np.sqrt(du * du + dv * dv) / allowed[k]
                agree[k] = miss < 1.0
                if agree[k]:
                    worth += 1.0 - 0.5 * miss
            if worth > best:
                best = worth
                members[:] = agree
    return members


def _slice_shifts(
    cosine: FloatArray, sine: FloatArray, distance: FloatArray, place: FloatArray, slices: int, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Offset (S, 2) [m] of each slice's centre from the axis and its standard deviation (S,) [m].

    The latter is NaN where a slice has fewer than 8 points, or they determine the centre no better than one of them
    would. Given are, for each point, cosine and sine of its angle around the axis, its distance from the surface [m]
    and its slice.
    """

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, weights=values, minlength=slices), np.float64)

    count = np.bincount(place, minlength=slices)
    cc, cs, ss = total(cosine * cosine), total(cosine * sine), total(sine * sine)
    # One measurement of zero for each coordinate, with the noise of a point, keeps slices without points solvable.
    cc, ss = cc + 1.0, ss + 1.0
    cd, sd = total(cosine * distance), total(sine * distance)
    determinant = cc * ss - cs**2
    shift = np.stack([(ss * cd - cs * sd) / determinant, (cc * sd - cs * cd) / determinant], axis=1)
    error = sigma * np.sqrt((cc + ss) / determinant)
    return shift, np.where((count >= _LEAST_SLICE_POINTS) & (error < sigma), error, np.nan)


def _slice_count(length: float, radius: float, points: int) -> int:
    """Number of slices of a barrel of this length [m] and radius [m] with this number of points."""
    fine = length / (_SLICE_RADII * radius + _SLICE_LENGTH)
    return int(np.clip(min(fine, points / _POINTS_PER_SLICE), _FEWEST_SLICES, _MOST_SLICES))


def _ends(count: FloatArray, first: int, last: int, low: float, size: float) -> tuple[float, float]:
    """Ends [m] of the interval of bins first..last-1: where the counts cross half of the level beside each end."""
    near = max(_FEWEST_END_BINS, min(_MOST_END_BINS, (last - first) // 2))
    left = np.median(count[first : first + near])
    right = np.median(count[max(last - near, first) : last])
    start = first
    while start < last - 1 and count[start] < _END_LEVEL * left:
        start += 1
    end = last - 1
    while end > start and count[end] < _END_LEVEL * right:
        end -= 1
    # The outermost full bin may be filled in part, and spill over into the bin outside it.
    lead = min(count[start] / max(left, 1e-9), 1.0) + (min(count[start - 1] / max(left, 1e-9), 0.5) if start else 0.0)
    tail = min(count[end] / max(right, 1e-9), 1.0)
    tail += min(count[end + 1] / max(right, 1e-9), 0.5) if end + 1 < len(count) else 0.0
    return low + (start + 1 - lead) * size, low + (end + tail) * size
