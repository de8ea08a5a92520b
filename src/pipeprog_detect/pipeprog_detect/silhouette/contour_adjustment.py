"""Robust least squares of a cylinder on the limb edges of all views, with the sideways error of each view's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import hits, support_profile
from pipeprog_detect.silhouette.limb_edges import LimbEdges
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

# Scale of the robust (Cauchy) loss, and the unresolved error of one edge within a blur of its position [px].
ROBUST, FLOOR = 0.3, 0.1
# Edges placed worse than this standard deviation [px] do not count: the pixel is then the better estimate.
WORST_EDGE = 0.7
# Rounds of the robust weights, and standard deviation of the views' offsets [px] in the first and at the least.
ROUNDS, FIRST_OFFSET, LEAST_OFFSET = 25, 0.5, 0.02
# Distance of edges from the contour of the search, and from the refined one [px], and passes over the latter.
COARSE_REACH, FINE_REACH, FINE_PASSES = 2.5, 1.5, 3
# On a thin pipe edges count within this share of its half-width, to keep off the other line and the highlight [px].
THIN_REACH, LEAST_REACH = 0.3, 0.6
# Samples that a candidate step is judged by, and the least that measure a cylinder (five unknowns, four of each).
COARSE_SAMPLES, MIN_SAMPLES = 1200, 20


@dataclass(frozen=True)
class AdjustedCylinder:
    """A cylinder after least squares on its limb edges.

    Attributes:
        cylinder: the cylinder after the step.
        step: (5,) from the given cylinder to it; see `Scene.moved`.
        covariance: (5, 5) of the step [m^2].
        view_offset: (V,) sideways offset of each view [px].
        used: mask (N,) of the samples of which an edge counted.
        share: support (0 to 1) of its contour.
        samples: the N contour samples.
        edges: their limb edges.
    """

    cylinder: Cylinder
    step: FloatArray
    covariance: FloatArray
    view_offset: FloatArray
    used: NDArray[np.bool_]
    share: float
    samples: ContourSamples
    edges: LimbEdges


def adjusted(cylinder: Cylinder, scene: Scene, prior: FloatArray, so_far: FloatArray) -> AdjustedCylinder | None:
    """The cylinder after some passes of least squares, the edges sought anew in each; None where none is left.

    `prior` (5, 5): precision [1/m^2] of the start, from which `so_far` (5,) has led to `cylinder`.
    """
    scene = scene.shifted(np.zeros(len(scene.views)))
    step: FloatArray = np.zeros(5)
    for _ in range(FINE_PASSES):
        current = scene.moved(cylinder, step)
        if current.radius <= 0:
            return None
        samples, edges = scene.edges(current, _reach(current, scene, FINE_REACH))
        if len(samples) < MIN_SAMPLES:
            return None
        solution = _solve(samples, edges, len(scene.views), prior, so_far + step)
        step = step + solution.step
        scene = scene.shifted(solution.view_offset)
    found = scene.moved(cylinder, step)
    if found.radius <= 0:
        return None
    hit = hits(samples, edges.shifted(-(samples.jacobian @ solution.step)), scene.view_offset)
    share = support_profile(samples, hit).share
    return AdjustedCylinder(
        found, step, solution.covariance, solution.view_offset, solution.used, share, samples, edges
    )


def best_of(cylinder: Cylinder, scene: Scene, steps: Sequence[FloatArray], prior: FloatArray) -> FloatArray:
    """Of candidate steps (5,) the one that, after one pass on sub-pixel edges, explains most samples; so improved."""
    return max((_improved(cylinder, scene, step, prior) for step in steps), key=lambda trial: trial[1])[0]


def _improved(cylinder: Cylinder, scene: Scene, step: FloatArray, prior: FloatArray) -> tuple[FloatArray, float]:
    """A candidate step after one pass of least squares, and the share of samples that it explains."""
    current = scene.moved(cylinder, step)
    samples, edges = scene.edges(current, _reach(current, scene, COARSE_REACH), limit=COARSE_SAMPLES)
    if len(samples) < MIN_SAMPLES:
        return step, 0.0
    solution = _solve(samples, edges, len(scene.views), prior, step)
    explained = hits(samples, edges.shifted(-(samples.jacobian @ solution.step)), solution.view_offset)
    return step + solution.step, float(explained.mean())


def flatness(found: AdjustedCylinder, views: Sequence[View]) -> tuple[float, float]:
    """Share of a flat strip's displacement in the edges, beside a step of the cylinder, and its standard deviation."""
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


def _reach(cylinder: Cylinder, scene: Scene, pixels: float) -> float:
    """`pixels`, but less on a thin pipe, whose two contour lines and highlight lie within a few pixels."""
    distance = [np.linalg.norm(view.centre - cylinder.middle) for view in scene.views]
    half_width = [view.camera.fx * cylinder.radius / each for view, each in zip(scene.views, distance, strict=True)]
    return float(min(pixels, max(THIN_REACH * np.median(half_width), LEAST_REACH)))


@dataclass(frozen=True)
class _Solution:
    """A step (K,), its covariance (K, K), the sideways offset (V,) of each view [px], and mask (N,) of samples used."""

    step: FloatArray
    covariance: FloatArray
    view_offset: FloatArray
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
    jacobian = samples.jacobian
    sign = samples.sideways()
    unknowns = jacobian.shape[1]
    step: FloatArray = np.zeros(unknowns)
    offset = np.zeros(views)
    variance = FIRST_OFFSET**2
    rows = np.arange(len(samples))
    for _ in range(ROUNDS):
        predicted = jacobian @ step + sign * offset[samples.view]
        distance = np.where(np.isfinite(edges.offset), np.abs(edges.offset - predicted[:, None]), np.inf)
        nearest = np.argmin(distance, axis=1)
        used = np.isfinite(distance[rows, nearest]) & (edges.sigma[rows, nearest] < WORST_EDGE)
        seen = np.where(used, edges.offset[rows, nearest], 0.0)
        sigma = np.where(used, edges.sigma[rows, nearest], 1.0)
        residual = np.where(used, seen - predicted, 0.0)
        weight = used / (sigma**2 + FLOOR**2) / (1.0 + (residual / ROBUST) ** 2)
        weighted = jacobian * weight[:, None]
        own = np.bincount(samples.view, weight, views) + 1.0 / variance
        cross = np.stack([np.bincount(samples.view, sign * weighted[:, k], views) for k in range(unknowns)], axis=1)
        right = np.bincount(samples.view, sign * weight * seen, views)
        normal = weighted.T @ jacobian - (cross / own[:, None]).T @ cross + prior
        normal += np.diag(np.full(unknowns, 1e-9 * np.trace(normal)))
        step = np.linalg.solve(normal, weighted.T @ seen - cross.T @ (right / own) - prior @ so_far)
        offset = (right - cross @ step) / own
        active = own > 2.0 / variance
        if active.any():
            variance = max(float(np.mean(offset[active] ** 2 + 1.0 / own[active])), LEAST_OFFSET**2)
    remaining = np.where(used, seen - jacobian @ step - sign * offset[samples.view], 0.0)
    inverse = np.linalg.inv(normal)
    freed = weighted - (weight * sign)[:, None] * (cross / own[:, None])[samples.view]
    spread = _clustered(weighted * remaining[:, None], samples.view, used)
    spread = spread + _clustered(freed * remaining[:, None], samples.positions()[1], used)
    return _Solution(step, inverse @ spread @ inverse + inverse, offset, used)


def _clustered(scores: FloatArray, group: IntArray, used: NDArray[np.bool_]) -> FloatArray:
    """Sum (5, 5) of the outer products of the scores (N, 5) of each group, corrected for few groups."""
    total = np.stack([np.bincount(group, column) for column in scores.T], axis=1)
    groups = len(np.unique(group[used]))
    return total.T @ total * groups / max(groups - 3, 1)
