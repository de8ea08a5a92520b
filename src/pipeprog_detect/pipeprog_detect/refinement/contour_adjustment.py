# SPDX-License-Identifier: Apache-2.0
"""Robust least squares of a cylinder on the limb edges of all views, with the sideways error of each view's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import COMMON, EDGE, NO_EDGE, hits, support_profile
from pipeprog_detect.silhouette.limb_edges import LimbEdges
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

# Scale of the robust (Cauchy) loss, and the unresolved error of one edge within a blur of its position [px].
ROBUST, FLOOR = 0.3, 0.1
# Edges placed worse than this [px] do not count: an edge anywhere within `FINE_REACH` has a standard deviation of 0.87.
WORST_EDGE = 0.7
# The limb model's own error, common to all views: a tenth of a sharp image's blur [px].
MODEL_ERROR = 0.05
# Rounds of the robust weights, and standard deviation of the views' offsets [px] in the first and at the least.
ROUNDS, FIRST_OFFSET, LEAST_OFFSET = 25, 0.5, 0.02
# Distance of edges from the contour of the search, and from the refined one [px], and most passes over the latter: they
# end when one moves the contour by less than half of `FLOOR`, for its edges would be the same again [px rms].
COARSE_REACH, FINE_REACH, FINE_PASSES, SETTLED = 2.5, 1.5, 3, 0.05
# Samples that a candidate step is judged by, and the least that measure a cylinder (five unknowns, four of each).
COARSE_SAMPLES, MIN_SAMPLES = 1200, 20
# A view from far above or aside tells the depth a hundred times as precisely as those before the pipe, so that a single
# edge of texture in it decides. It counts with this many samples and more: where one in five has an edge by chance,
# five of eight have one once in a hundred times.
LEAST_IN_VIEW = 8


@dataclass(frozen=True)
class AdjustedCylinder:
    """A cylinder after least squares on its limb edges.

    Attributes:
        scene: of the cylinder after the step, with the offset of each view.
        step: (5,) from the given cylinder to it; see `Scene.moved`.
        covariance: (5, 5) of the step [m^2].
        used: mask (N,) of the samples of which an edge counted.
        hit: mask (N,) of the samples that an edge supports.
        share: support (0 to 1) of its contour.
        log_odds: logarithm of how much more probable its edges are on a pipe there than on texture.
        samples: the N contour samples.
        edges: their limb edges.
    """

    scene: Scene
    step: FloatArray
    covariance: FloatArray
    used: NDArray[np.bool_]
    hit: NDArray[np.bool_]
    share: float
    log_odds: float
    samples: ContourSamples
    edges: LimbEdges

    @property
    def cylinder(self) -> Cylinder:
        """The cylinder after the step."""
        return self.scene.cylinder

    @property
    def is_within_blur(self) -> bool:
        """Whether its two contour lines lie within two blurs, where one edge of anything looks the same."""
        return float(np.median(self.samples.half_width)) < self.scene.blur


def adjusted(scene: Scene, prior: FloatArray, so_far: FloatArray) -> AdjustedCylinder | None:
    """The scene's cylinder after some passes of least squares, the edges sought anew in each; None if none is left.

    `prior` (5, 5): precision [1/m^2] of the start, from which `so_far` (5,) has led to the cylinder.
    """
    scene = replace(scene, view_offset=np.zeros(len(scene.views)))
    step: FloatArray = np.zeros(5)
    for _ in range(FINE_PASSES):
        found = _pass(scene, step, prior, so_far + step, FINE_REACH)
        if found is None:
            return None
        samples, edges, solution = found
        step = step + solution.step
        moved = solution.displacement - scene.shift_of(samples)
        scene = replace(scene, view_offset=solution.view_offset)
        if float(np.sqrt(np.mean(moved**2))) < SETTLED:
            break
    scene = scene.moved(step)
    if scene.cylinder.radius <= 0:
        return None
    hit = hits(edges, solution.displacement)
    share, odds = support_profile(samples, hit).share, _log_odds(samples, hit, solution)
    return AdjustedCylinder(scene, step, solution.covariance, solution.used, hit, share, odds, samples, edges)


def best_of(scene: Scene, steps: FloatArray, prior: FloatArray) -> FloatArray:
    """Of candidate steps (K, 5) the most probable one after a pass on sub-pixel edges; so improved.

    Two edges side by side are both seen all along the pipe; which one is its contour is told by where the pipe starts
    from, too, with the precision `prior` (5, 5). Where edges are no more probable on a pipe than on texture, neither
    this nor the start itself, the step 0, counts.
    """
    trials = []
    for step in steps:
        found = _pass(scene, step, prior, step, COARSE_REACH, COARSE_SAMPLES)
        if found is None:
            trials.append((step, -np.inf))
        else:
            samples, edges, solution = found
            total, hit = step + solution.step, hits(edges, solution.displacement)
            odds = _log_odds(samples, hit, solution)
            if odds > 0.0:
                trials.append((total, max(odds - 0.5 * float(total @ prior @ total), 0.0)))
            elif step.any() or len(steps) == 1:
                trials.append((total, odds))
    return max(trials, key=lambda trial: trial[1])[0]


def _log_odds(samples: ContourSamples, hit: NDArray[np.bool_], solution: _Solution) -> float:
    """Logarithm of how much more probable the edges are on a pipe in these places than on texture.

    Edges alone do not tell: one side of a pipe with the edge of its shadow is seen as often as the pipe, but at another
    depth, where the offsets of the views must make up for the parallax of cameras that are not in one line.
    """
    views = len(np.unique(samples.view))
    each = np.where(hit, EDGE, NO_EDGE)
    offset = solution.view_offset[np.unique(samples.view)]
    scatter = max(float(np.sqrt(np.mean(offset**2))), LEAST_OFFSET)
    return float(each.sum() / (1.0 + COMMON * (views - 1))) - views * float(np.log(scatter / FIRST_OFFSET))


def _pass(
    scene: Scene, step: FloatArray, prior: FloatArray, so_far: FloatArray, reach: float, limit: int | None = None
) -> tuple[ContourSamples, LimbEdges, _Solution] | None:
    """Least squares from the scene's cylinder after a `step` (5,).

    Args:
        scene: the cylinder in its views.
        step: of the cylinder.
        prior: precision (5, 5) of the start [1/m^2].
        so_far: (5,) from that start to the cylinder after the step.
        reach: distance of edges from the contour [px].
        limit: how many samples are used at the most; all if None.

    Returns:
        The samples, their edges and the solution; None where too few are visible or no cylinder is left.
    """
    current = scene.moved(step)
    if current.cylinder.radius <= 0:
        return None
    reach = current.within(reach)
    samples, edges = current.edges(reach, limit=limit)
    telling = np.bincount(samples.view, minlength=len(scene.views))[samples.view] >= LEAST_IN_VIEW
    if telling.sum() >= MIN_SAMPLES:
        samples, edges = samples.select(telling), edges.select(telling)
    if len(samples) < MIN_SAMPLES:
        return None
    return samples, edges, _solve(samples, edges, len(scene.views), prior, so_far)


def flatness(found: AdjustedCylinder) -> tuple[float, float]:
    """Share of a flat strip's displacement in the edges, beside a step of the cylinder, and its standard deviation."""
    views = found.scene.views
    strip = _as_strip(found.samples, found.cylinder, views)
    widened = replace(found.samples, jacobian=np.column_stack([found.samples.jacobian, strip]))
    solution = _solve(widened, found.edges, len(views), np.zeros((6, 6)), np.zeros(6))
    return float(solution.step[5]), float(np.sqrt(solution.covariance[5, 5]))


def _as_strip(samples: ContourSamples, cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    """Outward displacement (N,) [px] of the contour if a flat strip that faces the mean view were in its place.

    Seen from an angle off its normal a strip of half-width R looks R cos(angle) wide, a cylinder as wide as before.
    """
    towards = np.stack([view.centre - cylinder.middle for view in views])
    towards = towards - np.outer(towards @ cylinder.axis, cylinder.axis)
    towards = towards / (np.linalg.norm(towards, axis=1)[:, None] + 1e-12)
    facing = towards[np.unique(samples.view)].sum(axis=0)
    facing = facing / (np.linalg.norm(facing) + 1e-12)
    return np.asarray(samples.half_width * (towards @ facing - 1.0)[samples.view], np.float64)


@dataclass(frozen=True)
class _Solution:
    """The result of least squares.

    Attributes:
        step: (K,) of the unknowns.
        covariance: (K, K) of the step.
        view_offset: (V,) sideways offset of each view [px].
        displacement: (N,) of the samples outwards, by step and offset [px].
        used: mask (N,) of the samples of which an edge counted.
    """

    step: FloatArray
    covariance: FloatArray
    view_offset: FloatArray
    displacement: FloatArray
    used: NDArray[np.bool_]


def _solve(samples: ContourSamples, edges: LimbEdges, views: int, prior: FloatArray, so_far: FloatArray) -> _Solution:
    """Robust least squares for a step (K,), K columns of the Jacobian, with an offset of each view as a random effect.

    A wrong pose moves both lines of a view together, which says nothing about the radius: the offsets' variance is
    estimated from the views' scatter (expectation maximisation), so that with true poses they vanish. `prior` (K, K) is
    the precision [1/m^2] of the start, from which `so_far` (K,) has led: where the views lie in a row along the pipe,
    only the cloud knows its distance.

    The covariance clusters the residuals by view and by position (sandwich estimator): edges along one line share the
    error of its pose, edges at one position that of its texture.
    """
    jacobian, sign = samples.jacobian, samples.sideways()
    step, offset, normal, rows = _rounds(
        jacobian, sign, samples.view, (edges.offset, edges.sigma), views, (prior, prior @ so_far)
    )
    used, weight, remaining, own = rows[:, 0] > 0.0, rows[:, 1], rows[:, 2], rows[:, 3]
    weighted = jacobian * weight[:, None]
    cross = np.stack([np.bincount(samples.view, sign * column, views) for column in weighted.T], axis=1)
    inverse = np.linalg.inv(normal)
    freed = weighted - (weight * sign / own)[:, None] * cross[samples.view]
    spread = _clustered(weighted * remaining[:, None], samples.view, used)
    spread = spread + _clustered(freed * remaining[:, None], samples.positions()[1], used)
    displacement = jacobian @ step + sign * offset[samples.view]
    return _Solution(step, inverse @ spread @ inverse + inverse, offset, displacement, used)


@njit(cache=True, nogil=True)
def _rounds(
    jacobian: FloatArray,
    sign: FloatArray,
    view: IntArray,
    edges: tuple[FloatArray, FloatArray],
    views: int,
    start: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The rounds of the robust weights: step (K,), offsets (V,) and the last round's normal equations (K, K).

    And (N, 4) of each sample: 1 where an edge counted, else 0; its weight; what step and offset leave of its distance
    [px]; and the weight of its view's offset. `edges`: offset and sigma (N, M) [px]; `start`: the precision (K, K) of
    the start, and its right-hand side (K,).
    """
    count, unknowns = jacobian.shape
    place, sigma = edges
    prior, pull = start
    step: FloatArray = np.zeros(unknowns)
    offset = np.zeros(views)
    normal = np.empty((unknowns, unknowns))
    own, right, cross = np.empty(views), np.empty(views), np.empty((views, unknowns))
    chosen = np.empty(count, np.int64)
    rows = np.zeros((count, 4))
    variance = FIRST_OFFSET**2
    for _ in range(ROUNDS):
        own[:], right[:], cross[:] = 1.0 / variance, 0.0, 0.0
        normal[:] = prior
        along = -pull
        for i in range(count):
            predicted = sign[i] * offset[view[i]]
            for k in range(unknowns):
                predicted += jacobian[i, k] * step[k]
            best, least = -1, np.inf
            for m in range(place.shape[1]):
                distance = abs(place[i, m] - predicted)
                if distance < least:
                    best, least = m, distance
            chosen[i] = best if best >= 0 and sigma[i, best] < WORST_EDGE else -1
            if chosen[i] < 0:
                rows[i, 1] = 0.0
                continue
            seen = place[i, best]
            weight = 1.0 / (sigma[i, best] ** 2 + FLOOR**2) / (1.0 + ((seen - predicted) / ROBUST) ** 2)
            rows[i, 1] = weight
            own[view[i]] += weight
            right[view[i]] += sign[i] * weight * seen
            for k in range(unknowns):
                part = weight * jacobian[i, k]
                cross[view[i], k] += sign[i] * part
                along[k] += part * seen
                for other in range(k + 1):
                    normal[k, other] += part * jacobian[i, other]
        for v in range(views):
            for k in range(unknowns):
                share = cross[v, k] / own[v]
                along[k] -= share * right[v]
                for other in range(k + 1):
                    normal[k, other] -= share * cross[v, other]
        trace = 0.0
        for k in range(unknowns):
            trace += normal[k, k]
            for other in range(k):
                normal[other, k] = normal[k, other]
        for k in range(unknowns):
            normal[k, k] += 1e-9 * trace
        step[:] = np.linalg.solve(normal, along)
        total, active = 0.0, 0
        for v in range(views):
            offset[v] = right[v]
            for k in range(unknowns):
                offset[v] -= cross[v, k] * step[k]
            offset[v] /= own[v]
            if own[v] > 2.0 / variance:
                total += offset[v] ** 2 + 1.0 / own[v]
                active += 1
        if active:
            variance = max(total / active, LEAST_OFFSET**2)
    for i in range(count):
        rows[i, 3] = own[view[i]]
        if chosen[i] >= 0:
            rows[i, 0], rows[i, 2] = 1.0, place[i, chosen[i]] - sign[i] * offset[view[i]]
            for k in range(unknowns):
                rows[i, 2] -= jacobian[i, k] * step[k]
    return step, offset, normal, rows


def _clustered(scores: FloatArray, group: IntArray, used: NDArray[np.bool_]) -> FloatArray:
    """Sum (5, 5) of the outer products of the scores (N, 5) of each group, corrected for few groups."""
    total = np.stack([np.bincount(group, column) for column in scores.T], axis=1)
    groups = len(np.unique(group[used]))
    return total.T @ total * groups / max(groups - 3, 1)
