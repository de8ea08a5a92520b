# SPDX-License-Identifier: Apache-2.0
"""Thin pipes along a known direction: of each line that a keyframe shows, all keyframes are asked at every depth.

It does for axes of one direction and radius what a plane sweep (R. T. Collins, 1996) does for points: where a pipe is,
the keyframes that see the place show edges on both of its sides, all along; elsewhere as often as texture has them. At
every depth the same evidence is counted, so a line that has several explanations gets the one that most keyframes bear
out, not the first one found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.silhouette.edge_support import COMMON, HIT_RATE, MIN_VIEWS
from pipeprog_detect.silhouette.occlusion import BEFORE
from pipeprog_detect.thin.percentiles import percentile
from pipeprog_detect.thin.rectified_view import BLOCK, EDGE, UNKNOWN, RectifiedView, rectified_views
from pipeprog_detect.threads import THREADS, mapped
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import DECISIVE

# Where there is a pipe both sides show an edge; chance makes both do so at least this often.
BOTH, LEAST_CHANCE = HIT_RATE**2, 0.02
# Log odds that make a line of a view: a million runs of cells begin in it (a thousand rows, widths and columns).
LINE = float(np.log(1e6))
# Half-widths [rows] from which on two edges are told apart, and by which the half-width of a line may be wrong.
NARROWEST, WIDER = 1.5, 1.0
# The nearest distance from a camera at which pipes are sought [m]: they are filmed from farther away.
NEAREST = 0.3
# Depths are tried in steps that move the line by two rows in a view this far away [m]: edges count within a row, and
# the views that see a pipe lie about so far apart.
STEP_ROWS, BASELINE = 2.0, 1.5
# Evidence is gathered in stretches of this length [m], shorter than a clamp, up to this far from a line's middle [m].
STRETCH, LONGEST = 0.05, 3.0
# A pipe shows its edges about as often all along. What has less than half of the log odds, per view, of its clearer
# quarter is something else in line with it. It ends the pipe where it has lost these log odds by that (a hundred to
# one), and more than two stretches cost (0.64 of a clear one each): no clamp ends it.
LEVEL, CLEARER, ENDED, CLAMPED = 0.5, 75.0, float(np.log(100.0)), 1.5
# Pipes in one line within that reach: of three in a rack, end to end, the middle one's line shows both others.
IN_LINE = 3
# While the depth of a line is sought a stretch is two of its columns at every depth (24 px, 5 cm at 2 m), and odds are
# told in these: what is longer because it is farther away has no more evidence.
COLUMNS = 2
# The largest uncertainty [m] of the distance of a line that is taken for found: two standard deviations of it are the
# range of depths that are not decisively less probable than the best one.
VAGUEST = 0.3
# Lines that pass each other at less than this many radii, seen from where they are seen, are the same.
SAME_LINE = 1.0
# Every second view's lines are looked for at all depths: neighbours show the same ones.
EVERY = 2
# The lines are asked about in this many parts, which take unequally long.
PARTS = 4 * THREADS


@dataclass(frozen=True)
class Proposal:
    """A cylinder that may be a thin pipe, the standard deviation of its distance [m], and its log odds."""

    cylinder: Cylinder
    depth_sigma: float
    log_odds: float


def propose_parallel(
    views: Sequence[View], directions: Sequence[FloatArray], radii: Sequence[float], known: Sequence[Cylinder]
) -> list[Proposal]:
    """Cylinders along the `directions` (3,), of the given radii [m], that several views show; most probable first.

    `known`: pipes, which hide what is behind them, and whose contours are no evidence.
    """
    found: list[Proposal] = []
    for direction in directions:
        rectified = rectified_views(views, direction, known)
        if rectified:
            stack = _Stack.of(rectified)
            for radius in radii:
                found += _proposals(_swept(stack, radius), direction, radius)
    return sorted(found, key=lambda each: -each.log_odds)


@dataclass(frozen=True)
class _Stack:
    """V rectified views as arrays: `place` (V, 8), `edges` (V, R, C), `reach` (V, R / BLOCK, C); `size` (V, 2) used."""

    place: FloatArray
    size: IntArray
    edges: NDArray[np.uint8]
    reach: NDArray[np.float32]

    @classmethod
    def of(cls, views: Sequence[RectifiedView]) -> _Stack:
        size = np.array([each.edges.shape for each in views], np.int64)
        rows, columns = size.max(axis=0)
        edges = np.full((len(views), rows, columns), UNKNOWN, np.uint8)
        reach = np.zeros((len(views), -(-rows // BLOCK), columns), np.float32)
        for number, each in enumerate(views):
            edges[number, : size[number, 0], : size[number, 1]] = each.edges
            reach[number, : len(each.reach), : size[number, 1]] = each.reach
        return cls(np.stack([each.place for each in views]), size, edges, reach)


# What the columns of the axes found hold: log odds; the place across the direction, and from where to where along it;
# the uncertainty of the distance; number of views that agree, and their mean centre across the direction and along it,
# all in m; and the number of the line.
_ODDS, _X, _Y, _LOW, _HIGH, _SIGMA, _VIEWS, _CENTRE_X, _CENTRE_Y, _CENTRE_ALONG, _LINE = range(11)
_PLACE, _REACH, _CENTRE, _COLUMNS = slice(_X, _Y + 1), slice(_LOW, _HIGH + 1), slice(_CENTRE_X, _CENTRE_Y + 1), 11


def _swept(stack: _Stack, radius: float) -> FloatArray:
    """Axes (N, _COLUMNS) of cylinders of a radius [m]: for each line of every second view the most probable one."""
    widest = int(2.0 * radius / NEAREST / stack.place[:, 4].min())
    chance = _chances(stack.edges, stack.size, widest)
    odds = np.stack([np.log(BOTH / chance), np.log((1.0 - BOTH) / (1.0 - chance))], axis=-1)

    def lines_of(number: int) -> FloatArray:
        rows, columns = stack.size[number]
        found = _lines(np.ascontiguousarray(stack.edges[number, :rows, :columns]), odds[number], int(2.0 * NARROWEST))
        return np.column_stack([np.full(len(found), number), found])

    def axes_of(lines: FloatArray) -> FloatArray:
        arrays = stack.place, stack.size, stack.edges, stack.reach, odds, radius
        found = mapped(lambda part: _at_best_depth(part, *arrays), np.array_split(lines, PARTS))
        axes = np.concatenate(found)
        axes[:, _LINE] = np.repeat(np.arange(len(lines)), IN_LINE)
        return _distinct(axes, radius)

    every = np.concatenate(mapped(lines_of, range(0, len(stack.place), EVERY)))
    axes = axes_of(every)
    # The line of one view is a piece of the pipe: all of it tells the depth better.
    return axes_of(_whole(every[axes[:, _LINE].astype(np.int64)], axes, stack.place))


def _whole(lines: FloatArray, axes: FloatArray, place: FloatArray) -> FloatArray:
    """The lines (N, 6) from where to where their axes (N, _COLUMNS) reach."""
    at = place[lines[:, 0].astype(np.int64)]
    away = np.linalg.norm(axes[:, _PLACE] - at[:, :2], axis=1)
    columns = (axes[:, _REACH] - at[:, 2, None]) / (away * at[:, 6])[:, None] - at[:, 5, None]
    whole = lines.copy()
    whole[:, 2], whole[:, 3] = np.floor(columns[:, 0]), np.ceil(columns[:, 1]) - 1.0
    return whole


def _distinct(axes: FloatArray, radius: float) -> FloatArray:
    """The most probable of the axes (N, _COLUMNS) that cover each other, seen from where they are seen, best first."""
    axes = axes[(axes[:, _ODDS] > DECISIVE) & (axes[:, _VIEWS] >= MIN_VIEWS)]
    axes = axes[np.argsort(-axes[:, _ODDS], kind="stable")]
    kept = np.zeros((0, _COLUMNS))
    for one in axes:
        centre, along = one[_CENTRE], one[_CENTRE_ALONG]
        offset, others = one[_PLACE] - centre, kept[:, _PLACE] - centre
        far = np.linalg.norm(others, axis=1)
        aside = np.abs(offset[0] * others[:, 1] - offset[1] * others[:, 0]) / far
        low, high = (one[_REACH] - along) / np.linalg.norm(offset)
        lows, highs = ((kept[:, _REACH] - along) / far[:, None]).T
        common = np.minimum(highs, high) > np.maximum(lows, low)
        if not ((aside < SAME_LINE * radius) & common & (others @ offset > 0.0)).any():
            kept = np.vstack([kept, one])
    return kept


def _proposals(axes: FloatArray, direction: FloatArray, radius: float) -> list[Proposal]:
    """The axes (N, _COLUMNS) along a direction (3,) as cylinders of a radius [m], but for those of unknown depth."""
    axes = axes[axes[:, _SIGMA] < VAGUEST]
    feet = axes[:, _PLACE] @ np.stack(basis(direction))
    return [
        Proposal(Cylinder(foot + low * direction, foot + high * direction, radius), float(sigma), float(odds))
        for foot, (low, high), sigma, odds in zip(feet, axes[:, _REACH], axes[:, _SIGMA], axes[:, _ODDS], strict=True)
    ]


@njit(cache=True, nogil=True)
def _chances(edges: NDArray[np.uint8], size: IntArray, widest: int) -> FloatArray:
    """How often (V, W) cells at each distance, in half rows up to twice the half-width `widest`, both show an edge."""
    result = np.empty((len(edges), widest + 1))
    for v in range(len(edges)):
        for width in range(widest + 1):
            low, high = width // 2, (width + 1) // 2
            seen, both = 0, 0
            for row in range(low, size[v, 0] - high):
                for column in range(row % 4, size[v, 1], 4):  # a quarter of the cells tells the rate
                    one, other = edges[v, row - low, column], edges[v, row + high, column]
                    if one != UNKNOWN and other != UNKNOWN:
                        seen += 1
                        both += one == EDGE and other == EDGE
            result[v, width] = min(max(both / max(seen, 1), LEAST_CHANCE), BOTH)
    return result


@njit(cache=True, nogil=True)
def _lines(edges: NDArray[np.uint8], odds: FloatArray, narrowest: int) -> FloatArray:
    """Runs of cells (R, C) with an edge on both sides: row, first and last column, width [half rows], log odds (N, 5).

    `odds` (W, 2): log odds of a cell with both edges, and of one without, by width. Of neighbouring rows and widths
    the best run counts.
    """
    rows, columns = edges.shape
    found = [(0.0, 0.0, 0.0, 0.0, 0.0) for _ in range(0)]
    for width in range(narrowest, len(odds)):
        low, high = width // 2, (width + 1) // 2
        for row in range(low, rows - high):
            total, first, peak, last = 0.0, 0, 0.0, 0
            for column in range(columns + 1):
                step = -np.inf
                if column < columns:
                    one, other = edges[row - low, column], edges[row + high, column]
                    if one == UNKNOWN or other == UNKNOWN:
                        continue
                    step = odds[width, 0] if one == EDGE and other == EDGE else odds[width, 1]
                if total + step <= 0.0 or total + step < peak - LINE:
                    if peak >= LINE:
                        found.append((float(row), float(first), float(last), float(width), peak))
                    total, peak, first = 0.0, 0.0, column + 1
                    continue
                total += step
                if total > peak:
                    peak, last = total, column
    runs = np.empty((len(found), 5))
    for k in range(len(found)):
        runs[k, 0], runs[k, 1], runs[k, 2], runs[k, 3], runs[k, 4] = found[k]
    taken = np.zeros((rows, columns), np.bool_)
    kept = 0
    for k in np.argsort(-runs[:, 4], kind="mergesort"):
        row, first, last = int(runs[k, 0]), int(runs[k, 1]), int(runs[k, 2])
        if 2 * taken[row, first : last + 1].sum() > last + 1 - first:
            continue
        taken[max(row - 1, 0) : row + 2, first : last + 1] = True
        found[kept] = (float(row), float(first), float(last), runs[k, 3], runs[k, 4])
        kept += 1
    result = np.empty((kept, 5))
    for k in range(kept):
        result[k, 0], result[k, 1], result[k, 2], result[k, 3], result[k, 4] = found[k]
    return result


@njit(cache=True, nogil=True, inline="always")
def _block_of(row: float, rows: int) -> int:
    """The nearest row of `RectifiedView.reach` to one of the `rows` of a view."""
    return min(int(row + 0.5 * BLOCK), rows - 1) // BLOCK


@njit(cache=True, nogil=True)
def _weigh(
    at: tuple[float, float, float, float],
    total: FloatArray,
    weight: FloatArray,
    place: FloatArray,
    size: IntArray,
    edges: NDArray[np.uint8],
    reach: NDArray[np.float32],
    odds: FloatArray,
    radius: float,
) -> tuple[int, float, float, float]:
    """Sets `total` (B,) to the log odds of a cylinder's stretches; number of views that agree, and their mean centre.

    And `weight` (B,) to the number of independent views that see each.

    `at`: the place across the direction (2) and where the first stretch begins, and how long each is [m]; the others:
    see `_Stack`, and `_lines` for `odds` (V, W, 2).
    """
    x, y, low, step = at
    total[:], weight[:] = 0.0, 0.0
    agreeing, centre_x, centre_y, centre_along = 0, 0.0, 0.0, 0.0
    for v in range(len(place)):
        dx, dy = x - place[v, 0], y - place[v, 1]
        away = np.sqrt(dx * dx + dy * dy)
        if away < NEAREST:
            continue
        turn = np.arctan2(dy, dx) - place[v, 3]
        turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
        row, half = turn / place[v, 4] + place[v, 7], radius / away / place[v, 4]
        one, other = int(np.round(row - half)), int(np.round(row + half))
        if one < 0 or other >= size[v, 0] or half < NARROWEST:
            continue
        width = min(int(np.round(2.0 * half)), odds.shape[1] - 1)
        block = _block_of(row, size[v, 0])
        own = 0.0
        for b in range(len(total)):
            column = int(np.floor((low + (b + 0.5) * step - place[v, 2]) / away / place[v, 6] - place[v, 5]))
            if column < 0 or column >= size[v, 1] or away - radius > reach[v, block, column] + BEFORE:
                continue
            first, second = edges[v, one, column], edges[v, other, column]
            if first == UNKNOWN or second == UNKNOWN:
                continue
            gain = odds[v, width, 0] if first == EDGE and second == EDGE else odds[v, width, 1]
            total[b] += gain
            weight[b] += 1.0
            own += gain
        if own > 0.0:
            agreeing += 1
            centre_x, centre_y = centre_x + place[v, 0], centre_y + place[v, 1]
            centre_along += place[v, 2]
    for b in range(len(total)):
        alike = 1.0 + COMMON * max(weight[b] - 1.0, 0.0)
        total[b], weight[b] = total[b] / alike, weight[b] / alike
    share = 1.0 / max(agreeing, 1)
    return agreeing, share * centre_x, share * centre_y, share * centre_along


@njit(cache=True, nogil=True)
def _middle_row(row: float, width: int) -> float:
    """The row in the middle between the edges of a line that `_lines` gives; `width`: in half rows."""
    return row + 0.5 * (width % 2)


@njit(cache=True, nogil=True)
def _inverse_step(angle: float) -> float:
    """Step of inverse depth [1/m] that moves a line by STEP_ROWS in a view BASELINE away; `angle` of a row [rad]."""
    return STEP_ROWS * angle / BASELINE


@njit(cache=True, nogil=True)
def _distances(
    line: FloatArray, place: FloatArray, size: IntArray, reach: NDArray[np.float32], radius: float
) -> FloatArray:
    """The distances (D,) [m] from the camera, farthest first, that the width of a line (6,) and what hides it allow.

    `place` (8,), `size` (2,) and `reach` (R / BLOCK, C) are those of the line's view.
    """
    first, last, width = int(line[2]), int(line[3]), int(line[4])
    inside = min(max(first, 0), size[1] - 1)
    seen = reach[_block_of(_middle_row(line[1], width), size[0]), inside : max(last, inside) + 1]
    near = (0.5 * width + WIDER) * place[4] / radius  # inverse distances
    far = max(max(0.5 * width - WIDER, 0.5) * place[4] / radius, 1.0 / (seen.max() + BEFORE))
    if far >= near:
        return np.empty(0)
    return 1.0 / np.linspace(far, near, int((near - far) / _inverse_step(place[4])) + 2)


@njit(cache=True, nogil=True)
def _best_run(gains: FloatArray, weight: FloatArray) -> tuple[float, int, int]:
    """The log odds of the most probable pipe in a line, where it begins, and where it ends; 0 without one.

    `gains` (B,) are the log odds of its stretches, `weight` (B,) the number of independent views that see each.
    """
    low, high = _largest_sum(gains, np.inf)
    seen = np.flatnonzero(weight[low:high] > 0.0) + low
    if not len(seen):
        return 0.0, 0, 0
    level = LEVEL * percentile(gains[seen] / weight[seen], CLEARER)
    clear = percentile(gains[seen], CLEARER)
    begin, end = _largest_sum(gains[low:high] - level * weight[low:high], max(ENDED, CLAMPED * clear))
    return gains[low + begin : low + end].sum(), low + begin, low + end


@njit(cache=True, nogil=True)
def _largest_sum(gains: FloatArray, ended: float) -> tuple[int, int]:
    """Begin and end of the run of gains (B,) with the largest sum; none goes on where it has lost `ended` of it."""
    best, low, high = 0.0, 0, 0
    running, peak, begin = 0.0, 0.0, 0
    for b in range(len(gains)):
        if running <= 0.0 or running < peak - ended:
            running, peak, begin = 0.0, 0.0, b
        running += gains[b]
        peak = max(peak, running)
        if running > best:
            best, low, high = running, begin, b + 1
    return low, high


@njit(cache=True, nogil=True)
def _width_of_peak(distances: FloatArray, scores: FloatArray) -> float:
    """The range [m] of distances (D,) about the best one whose scores (D,) are more than half of its.

    An edge counts within a row, so that its own error may as well move the peak as far as it is wide.
    """
    first = last = scores.argmax()
    half = 0.5 * scores[first]
    while first > 0 and scores[first - 1] > half:
        first -= 1
    while last < len(scores) - 1 and scores[last + 1] > half:
        last += 1
    return abs(distances[last] - distances[first])


@njit(cache=True, nogil=True)
def _at_best_depth(
    lines: FloatArray,
    place: FloatArray,
    size: IntArray,
    edges: NDArray[np.uint8],
    reach: NDArray[np.float32],
    odds: FloatArray,
    radius: float,
) -> FloatArray:
    """The axes (M, _COLUMNS) of lines (N, 6), which are a view's number and what `_lines` gives; 0 where there is none.

    Each line has up to `IN_LINE` of them, end to end; their `_LINE` is left open. For the other arguments see `_weigh`.
    """
    result = np.zeros((len(lines) * IN_LINE, _COLUMNS))
    longest = int(2.0 * LONGEST / STRETCH)
    for k in range(len(lines)):
        v, first, last = int(lines[k, 0]), int(lines[k, 2]), int(lines[k, 3])
        distances = _distances(lines[k], place[v], size[v], reach[v], radius)
        angle = place[v, 3] + (_middle_row(lines[k, 1], int(lines[k, 4])) - place[v, 7]) * place[v, 4]
        across, up = np.cos(angle), np.sin(angle)
        least, most = (first + place[v, 5]) * place[v, 6], (last + 1.0 + place[v, 5]) * place[v, 6]
        count = max((last + 1 - first) // COLUMNS, 3)
        total, weight = np.empty(max(longest, count)), np.empty(max(longest, count))
        scores = np.empty(len(distances))
        for d, away in enumerate(distances):
            low, step = place[v, 2] + least * away, (most - least) * away / count
            at = (place[v, 0] + away * across, place[v, 1] + away * up, low, step)
            _weigh(at, total[:count], weight[:count], place, size, edges, reach, odds, radius)
            scores[d] = total[:count].sum()
        if not (scores > 0.0).any():
            continue
        away = distances[scores.argmax()]
        likely = distances[scores > scores.max() - DECISIVE]
        # Half of the range is two standard deviations; the next step might be as good.
        widest = max(likely.max() - likely.min(), _width_of_peak(distances, scores))
        sigma = 0.25 * widest + 0.5 * _inverse_step(place[v, 4]) * away**2
        x, y = place[v, 0] + away * across, place[v, 1] + away * up
        low = place[v, 2] + 0.5 * (least + most) * away - LONGEST
        at = (x, y, low, STRETCH)
        gains, views = total[:longest], weight[:longest]
        agreeing, centre_x, centre_y, along = _weigh(at, gains, views, place, size, edges, reach, odds, radius)
        for each in range(IN_LINE):
            best, begin, end = _best_run(gains, views)
            gains[begin:end] = -np.inf
            row = result[k * IN_LINE + each]
            row[_ODDS] = best * STRETCH / (COLUMNS * place[v, 6] * away)
            row[_X], row[_Y], row[_SIGMA], row[_VIEWS] = x, y, sigma, agreeing
            row[_LOW], row[_HIGH] = low + begin * STRETCH, low + end * STRETCH
            row[_CENTRE_X], row[_CENTRE_Y], row[_CENTRE_ALONG] = centre_x, centre_y, along
    return result
