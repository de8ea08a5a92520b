"""From a hypothesis to a measured cylinder, or to the reason why it is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.extent import Run, straight_stretch, surface_runs
from pipeprog_detect.fit import CylinderFit, basis, covered_arc, fit_cylinder
from pipeprog_detect.octree import IntArray, Octree
from pipeprog_detect.pipe import Cylinder, FloatArray

_FIT_POINTS = 6000
_FINAL_POINTS = 20000


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a cylinder.

    arc [rad] of the surface seen; coverage: share of the length that shows surface; inside: points within the barrel,
    well under its surface, per point on it; beyond: points close outside the seen surface, per point on it;
    noise [m]: spread of the points across the surface; roundness [m]: root mean square over the sectors of the
    section of their mean distance from the circle, 0 for a true one; flatness: mean square from the best plane over the mean square
    from the cylinder.
    """

    arc: float
    coverage: float
    inside: float
    beyond: float
    noise: float
    roundness: float
    flatness: float


@dataclass(frozen=True)
class Candidate:
    """A measured cylinder, its fit, the rows of the tree on its surface, the stretches seen, and the evidence."""

    cylinder: Cylinder
    fit: CylinderFit
    rows: IntArray
    runs: list[Run]
    evidence: Evidence


def measure(tree: Octree, free: NDArray[np.bool_], initial: Cylinder, sigma: float) -> Candidate | None:
    """Fit `initial` to the free points of the tree, follow it along its axis to its ends, and collect the evidence.

    sigma [m] is the cloud's typical noise; a pipe's own may be up to twice that (head-on surfaces, waviness).
    """
    wide = 1.3 * sigma + 2e-4
    start, end = initial.start, initial.end
    cylinder = initial
    fit: CylinderFit | None = None
    runs: list[Run] = []
    for turn in range(12):
        axis = cylinder.axis
        step = max(0.5 * cylinder.length, 0.25, 4.0 * cylinder.radius) if turn else 0.0
        start, end = cylinder.start - step * axis, cylinder.end + step * axis
        # Hypotheses are right to a tenth of the radius; a wider reach would take in the neighbour of a rack.
        reach = 1.0 + 0.1 * cylinder.radius / wide if turn == 0 else 1.2
        rows = tree.near_segment(start, end, cylinder.radius + 4.0 * wide * reach)
        rows = rows[free[rows]]
        if len(rows) < 30:
            return None
        points = tree.points[rows]
        if turn:
            distance = _signed_distance(points, cylinder)
            skin = points[np.abs(distance) < 3.0 * wide]
            straight = straight_stretch(skin, cylinder, wide) if len(skin) > 30 else None
            if straight is None:
                return None
            skin = _within(skin, cylinder, straight)
            runs = _connected(surface_runs(skin, cylinder, 0.0), cylinder)
            if not runs:
                return None
            low, high = runs[0].low, runs[-1].high
            grown = max(-low, high - cylinder.length)
            cylinder = _cut(cylinder, low, high)
            points = _within(points, cylinder, Run(0.0, cylinder.length))
        else:
            grown = np.inf
        fit = fit_cylinder(_spread_out(points, _FIT_POINTS), None, cylinder, wide, reach=reach)
        if fit is None or not 0.6 * initial.radius < fit.cylinder.radius < 1.6 * initial.radius:
            return None
        wide = float(np.clip(1.3 * fit.rmse, 0.7 * sigma, 2.0 * sigma + 1e-3))
        cylinder = fit.cylinder if turn == 0 else _between(fit.cylinder, cylinder)
        if grown < 0.02 and turn >= 2:
            break
    return _finish(tree, free, cylinder, wide)


def thin_start(
    tree: Octree, free: NDArray[np.bool_], line: Cylinder, sigma: float, radii: Sequence[float]
) -> Cylinder | None:
    """The cylinder, of those of the given radii about a line through the points of a thin pipe, that explains most.

    The line runs through the mean of the points, that is before the axis by about half a radius on a side that is
    not known: each of eight sides is tried.
    """
    axis = line.axis
    u, v = basis(axis)
    rows = tree.near_segment(line.start, line.end, 2.5 * max(radii) + 4.0 * sigma)
    points = _spread_out(tree.points[rows[free[rows]]], 1500)
    best, most = None, 0.0
    for radius in radii:
        for angle in np.arange(8) * (np.pi / 4):
            shift = 0.6 * radius * (np.cos(angle) * u + np.sin(angle) * v)
            initial = Cylinder(line.start + shift, line.end + shift, radius)
            fit = fit_cylinder(points, None, initial, sigma, reach=1.0)
            if fit is None or not 0.6 * min(radii) < fit.cylinder.radius < 1.5 * max(radii):
                continue
            share = np.clip(1.0 - (_signed_distance(points, fit.cylinder) / (4.0 * sigma)) ** 2, 0.0, None)
            # The worth of a residual within the noise, per point; a wider circle fits a blob no better by that.
            worth = float((share**2).sum())
            if worth > most:
                best, most = fit.cylinder, worth
    return best


def _finish(tree: Octree, free: NDArray[np.bool_], cylinder: Cylinder, wide: float) -> Candidate | None:
    margin = cylinder.radius * cylinder.axis
    rows = tree.near_segment(cylinder.start - margin, cylinder.end + margin, cylinder.radius + 4.0 * wide)
    rows = rows[free[rows]]
    points = tree.points[rows]
    along = (points - cylinder.start) @ cylinder.axis
    body = points[(along >= 0) & (along <= cylinder.length)]
    fit = fit_cylinder(_spread_out(body, _FINAL_POINTS), None, cylinder, wide, reach=1.0)
    if fit is None:
        return None
    cylinder = _between(fit.cylinder, cylinder)
    distance = _signed_distance(points, cylinder)
    on = np.abs(distance) < 3.0 * wide
    if on.sum() < 30:
        return None
    straight = straight_stretch(points[on], cylinder, wide)
    if straight is None:
        return None
    runs = _connected(surface_runs(_within(points[on], cylinder, straight), cylinder, 0.0), cylinder)
    if not runs:
        return None
    cut = _cut(cylinder, runs[0].low, runs[-1].high)
    runs = [Run(run.low - runs[0].low, run.high - runs[0].low) for run in runs]
    along = (points - cut.start) @ cut.axis
    on &= (along >= 0) & (along <= cut.length)
    if on.sum() < 30:
        return None
    return Candidate(cut, fit, rows[on], runs, _evidence(tree, free, cut, runs, points[on], wide))


def _evidence(
    tree: Octree, free: NDArray[np.bool_], cylinder: Cylinder, runs: list[Run], surface: FloatArray, wide: float
) -> Evidence:
    radius = cylinder.radius
    distance = _signed_distance(surface, cylinder)
    arc = covered_arc(surface, cylinder)
    coverage = sum(run.length for run in runs) / cylinder.length
    shell = max(6.0 * wide, 0.5 * radius)
    rows = tree.near_segment(cylinder.start, cylinder.end, radius + shell)
    rows = rows[free[rows]]
    near = _signed_distance(tree.points[rows], cylinder)
    inside = float((near < -4.0 * wide).sum()) / len(surface)
    beyond = float((near > 4.0 * wide).sum()) / len(surface)
    offset = surface - surface.mean(axis=0)
    lateral = offset - (offset @ cylinder.axis)[:, None] * cylinder.axis
    values = np.linalg.eigvalsh(lateral.T @ lateral / len(lateral))
    square = float(np.mean(distance**2))
    roundness = _roundness(surface, cylinder, distance)
    return Evidence(
        arc, coverage, inside, beyond, float(np.sqrt(square)), roundness, float(values[1]) / max(square, 1e-12)
    )


def _roundness(points: FloatArray, cylinder: Cylinder, distance: FloatArray, sectors: int = 36) -> float:
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    sector = ((np.arctan2(offset @ v, offset @ u) + np.pi) * (sectors / (2 * np.pi))).astype(int) % sectors
    count = np.bincount(sector, minlength=sectors)
    mean = np.bincount(sector, weights=distance, minlength=sectors) / np.maximum(count, 1)
    # What the noise of a sector's mean adds is taken out.
    own = np.var(distance) / np.maximum(count, 1)
    square = np.average(mean**2 - own, weights=count)
    return float(np.sqrt(max(square, 0.0)))


def _signed_distance(points: FloatArray, cylinder: Cylinder) -> FloatArray:
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    square = np.einsum("ij,ij->i", offset, offset) - along**2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)) - cylinder.radius)


def _within(points: FloatArray, cylinder: Cylinder, run: Run) -> FloatArray:
    along = (points - cylinder.start) @ cylinder.axis
    return points[(along >= run.low) & (along <= run.high)]


def _connected(runs: list[Run], cylinder: Cylinder) -> list[Run]:
    """The runs that belong together: from the longest one outwards, over gaps a clamp or an occluder may explain."""
    gap = max(10.0 * cylinder.radius, 0.3)
    runs = [run for run in runs if run.length > max(0.5 * cylinder.radius, 0.015)]
    if not runs:
        return []
    core = int(np.argmax([run.length for run in runs]))
    first = last = core
    while first > 0 and _bridged(runs[first - 1], runs[first].low - runs[first - 1].high, gap, cylinder):
        first -= 1
    while last + 1 < len(runs) and _bridged(runs[last + 1], runs[last + 1].low - runs[last].high, gap, cylinder):
        last += 1
    return runs[first : last + 1]


def _bridged(run: Run, gap: float, most: float, cylinder: Cylinder) -> bool:
    """A short piece beyond a long gap is more likely something else."""
    return gap < min(most, max(4.0 * run.length, cylinder.radius))


def _cut(cylinder: Cylinder, low: float, high: float) -> Cylinder:
    return Cylinder(cylinder.start + low * cylinder.axis, cylinder.start + high * cylinder.axis, cylinder.radius)


def _between(line: Cylinder, ends: Cylinder) -> Cylinder:
    """The cylinder `line` with the ends of another one, projected."""
    axis = line.axis
    low, high = (ends.start - line.start) @ axis, (ends.end - line.start) @ axis
    return _cut(line, min(low, high), max(low, high))


def _spread_out(points: FloatArray, most: int) -> FloatArray:
    """At most `most` of the points, evenly along the Morton curve and so in space."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(np.int64)]
