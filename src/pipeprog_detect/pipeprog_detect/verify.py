"""From a hypothesis to a measured cylinder, or to the reason why it is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.extent import Run, surface_runs
from pipeprog_detect.fit import CylinderFit, covered_arc, fit_cylinder
from pipeprog_detect.octree import IntArray, Octree
from pipeprog_detect.pipe import Cylinder, FloatArray

_FIT_POINTS = 6000
_FINAL_POINTS = 20000


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a cylinder.

    arc [rad] of the surface seen; coverage: share of the length that shows surface; inside: points within the barrel,
    well under its surface, per point on it; beyond: points close outside the seen surface, per point on it;
    noise [m]: spread of the points across the surface; flatness: mean square from the best plane over the mean square
    from the cylinder.
    """

    arc: float
    coverage: float
    inside: float
    beyond: float
    noise: float
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
        reach = 4.0 if turn == 0 else 1.5
        rows = tree.near_segment(start, end, cylinder.radius + 4.0 * wide * reach)
        rows = rows[free[rows]]
        if len(rows) < 30:
            return None
        points = tree.points[rows]
        if turn:
            distance = _signed_distance(points, cylinder)
            runs = _connected(surface_runs(points[np.abs(distance) < 3.0 * wide], cylinder, 0.0), cylinder)
            if not runs:
                return None
            low, high = runs[0].low, runs[-1].high
            grown = max(-low, high - cylinder.length)
            cylinder = _cut(cylinder, low, high)
            along = (points - cylinder.start) @ cylinder.axis
            points = points[(along >= 0) & (along <= cylinder.length)]
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
    runs = _connected(surface_runs(points[on], cylinder, 0.0), cylinder)
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
    return Evidence(arc, coverage, inside, beyond, float(np.sqrt(square)), float(values[1]) / max(square, 1e-12))


def _signed_distance(points: FloatArray, cylinder: Cylinder) -> FloatArray:
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    square = np.einsum("ij,ij->i", offset, offset) - along**2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)) - cylinder.radius)


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
