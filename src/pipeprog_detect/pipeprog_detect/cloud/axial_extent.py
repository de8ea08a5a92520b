# SPDX-License-Identifier: Apache-2.0
"""Where a pipe begins and ends along its axis, and which pieces are one pipe."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.types import Cylinder

_SECTORS = 36
# A bin of the barrel is seen where its points cover this angle, a bin is empty under this share of its neighbours.
_LEAST_ARC = np.radians(30.0)
_LEAST_SHARE = 0.25
# Deviation [m] of a pipe's axis from a line by sagging and by the waviness of clouds, over its whole length; an elbow
# leaves the line by more within a fraction of its radius.
_AXIS_WAVINESS = 3e-3


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
    """Bins of 5 mm, or as long as it takes to hold a dozen points, at most the radius or 3 cm."""
    return float(np.clip(12.0 / max(points_per_metre, 1.0), 0.005, max(radius, 0.03)))


def surface_intervals(points: FloatArray, cylinder: Cylinder) -> list[Interval]:
    """Stretches of the axis along which points (N, 3), all near the surface, cover the pipe.

    Positions are metres from cylinder.start along its axis. Ends lie where the occupancy falls to half of the
    interval's own level, between bins by linear interpolation.
    """
    if len(points) < 10:
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
    # The arc is judged over three bins, since few points of a thin pipe fall in one.
    arc = grid.copy()
    arc[1:] |= grid[:-1]
    arc[:-1] |= grid[1:]
    needed = min(int(np.ceil(_LEAST_ARC / (2 * np.pi / _SECTORS))), 3)
    covered = arc.sum(axis=1) >= needed
    level = np.median(count[count > 0])
    seen = covered & (count > _LEAST_SHARE * min(level, _local_level(count)))
    intervals: list[Interval] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        intervals.append(Interval(*_ends(count, first, last, low, size)))
    return intervals


def straight_interval(points: FloatArray, cylinder: Cylinder, sigma: float) -> Interval | None:
    """The longest stretch of the axis on which the section's centre stays on one line: an elbow's does not.

    points (N, 3) lie near the surface, within a few `sigma` [m]. In each slice the offset of the section is solved
    for at the given radius; of the lines through two slices the one that most slices agree with is taken (it need not
    be the cylinder's axis, which an elbow may have tilted), and its slices from the first to the last that agree.
    """
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    u, v = basis(cylinder.axis)
    x, y = offset @ u, offset @ v
    rho = np.hypot(x, y) + 1e-12
    distance = rho - cylinder.radius
    length = float(along.max() - along.min())
    slices = int(np.clip(min(length / (0.3 * cylinder.radius + 0.005), len(points) / 16), 6, 120))
    low = float(along.min())
    size = length / slices
    place = np.clip(((along - low) / size).astype(int), 0, slices - 1)
    cosine, sine = x / rho, y / rho
    shift, error = _slice_shifts(cosine, sine, distance, place, slices, sigma)
    known = np.flatnonzero(np.isfinite(error))
    if len(known) < 4:
        return Interval(low, low + length)
    allowed = 2.5 * error + _AXIS_WAVINESS + 0.02 * cylinder.radius
    centre = np.asarray(low + (np.arange(slices) + 0.5) * size, np.float64)
    line = _best_line(centre[known], shift[known], allowed[known], max(slices // 6, 1) * size)
    if not line.any():
        return None
    members = known[line]
    parts = _contiguous_slices(members, known)
    longest = max(parts, key=len)
    slope, origin = _fit_line(centre[longest], shift[longest], np.asarray(1.0 / error[longest]))
    off = np.linalg.norm(shift - origin - centre[:, None] * slope, axis=1)
    deviation: FloatArray = np.where(off > 2.5 * error + 0.5 * _AXIS_WAVINESS, off, np.nan)
    edges = low + longest[0] * size, low + (longest[-1] + 1) * size
    return Interval(
        _onset(edges[0], centre[: longest[0]][::-1], deviation[: longest[0]][::-1], cylinder.radius),
        _onset(edges[1], centre[longest[-1] + 1 :], deviation[longest[-1] + 1 :], cylinder.radius),
    )


def _contiguous_slices(members: IntArray, known: IntArray) -> list[IntArray]:
    """The slices `members` parted where known slices between them disagree; a tee's few are bridged."""
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
        if hole <= 3 and min(len(bridged[-1]), len(part)) > 2 * hole + 1:
            bridged[-1] = np.append(bridged[-1], part)
        else:
            bridged.append(part)
    return bridged


def _onset(end: float, centre: FloatArray, deviation: FloatArray, radius: float) -> float:
    """Where the barrel ends before an elbow, given slices (S,) from the last straight one's edge `end` [m] outwards.

    A long-radius elbow turns about 1.5 diameters, so at s beyond its beginning the section is s^2 / (6 r) off the
    line: the first clearly bent slice tells where it began. Without a bend next to it the end stands.
    """
    near = slice(0, 2)
    if not np.isfinite(deviation[near]).any():
        return end
    first = int(np.flatnonzero(np.isfinite(deviation[near]))[0])
    back = np.sqrt(6.0 * radius * deviation[first])
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
    """Slices that agree with the line through two of them, at least `apart`, that most agree with, and closely."""
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
    """Offset (S, 2) [m] of each slice's section and its standard deviation (S,), NaN where too few points are."""

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, weights=values, minlength=slices), np.float64)

    count = np.bincount(place, minlength=slices)
    cc, cs, ss = total(cosine * cosine), total(cosine * sine), total(sine * sine)
    # A prior of a radius-sized shift would be arbitrary; one sigma on one point only keeps empty slices solvable.
    cc, ss = cc + 1.0, ss + 1.0
    cd, sd = total(cosine * distance), total(sine * distance)
    determinant = cc * ss - cs**2
    shift = np.stack([(ss * cd - cs * sd) / determinant, (cc * sd - cs * cd) / determinant], axis=1)
    error = sigma * np.sqrt((cc + ss) / determinant)
    return shift, np.where((count >= 8) & (error < sigma), error, np.nan)


def _local_level(count: FloatArray) -> float:
    return float(np.quantile(count[count > 0], 0.25))


def _ends(count: FloatArray, first: int, last: int, low: float, size: float) -> tuple[float, float]:
    """Ends [m] of the interval of bins first..last-1: where the counts cross half of the level beside each end."""
    near = max(3, min(8, (last - first) // 2))
    left = np.median(count[first : first + near])
    right = np.median(count[max(last - near, first) : last])
    start = first
    while start < last - 1 and count[start] < 0.5 * left:
        start += 1
    end = last - 1
    while end > start and count[end] < 0.5 * right:
        end -= 1
    # The outermost full bin may be filled in part, and spill over into the bin outside it.
    lead = min(count[start] / max(left, 1e-9), 1.0) + (min(count[start - 1] / max(left, 1e-9), 0.5) if start else 0.0)
    tail = min(count[end] / max(right, 1e-9), 1.0)
    tail += min(count[end + 1] / max(right, 1e-9), 0.5) if end + 1 < len(count) else 0.0
    return low + (start + 1 - lead) * size, low + (end + tail) * size
