"""Refinement of a cylinder by its outlines in the keyframes: radius and axis from all views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.config import ContourConfig
from pipeprog_detect.consensus import WINDOW_OF_HALF_WIDTH, responses, search
from pipeprog_detect.edges import LimbEdges, limb_edges, profiles
from pipeprog_detect.outline import Stations, camera_centre, frame, moved, stations, visible
from pipeprog_detect.pipe import Cylinder, FloatArray, View

# Pixels of outline that make one measurement: the mean over them tames texture, the line stays straight within.
CHUNK = 12
# The limb model's window: inwards as far as shading stays smooth, outwards to where the next thing may begin [px].
INWARD, OUTWARD = 8.0, 3.0
# Blur of an unresized camera image, lens and pixel together [px]; the model's offset hardly depends on it.
BLUR = 0.5
# Scale of the robust loss [px] and of the unresolved error of one edge within a blur of its place [px].
ROBUST, FLOOR = 0.3, 0.1
# A tenth of the blur remains as the limb model's own error, common to all views [px].
MODEL_ERROR = 0.05


@dataclass(frozen=True)
class ContourFit:
    """A cylinder measured by its outlines.

    `covariance` (5, 5) of the axis' offset at its middle (2) [m], its direction (2) [rad] and the radius [m], the
    directions being those of `basis` (2, 3); `support` share of the outline with an edge in three views or more.
    """

    cylinder: Cylinder
    covariance: FloatArray
    basis: FloatArray
    radius_sigma: float
    support: float
    views: int
    start_sigma: float
    end_sigma: float


def refine(
    cylinder: Cylinder,
    initial_radius_sigma: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    config: ContourConfig,
    planned_radii: Sequence[float] = (),
) -> ContourFit | None:
    """The cylinder that the outlines in all views agree on, or None where they say too little.

    Two stages: a vote over all edges near the predicted outlines (`consensus.search`), which finds the one rigid
    cylinder that explains most of them, since a shadow's or a neighbour's edge drifts against the pipe as the camera
    moves; then robust least squares on limb-aware sub-pixel edges. `planned_radii` only seed the vote.
    """
    basis = frame(cylinder, _viewing_direction(cylinder, views))
    coarse = _vote(cylinder, initial_radius_sigma, views, others, basis, planned_radii)
    if coarse is None:
        return None
    return _fit(coarse, views, others, basis)


def _viewing_direction(cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    middle = 0.5 * (cylinder.start + cylinder.end)
    directions = [middle - camera_centre(view) for view in views]
    return np.mean([direction / np.linalg.norm(direction) for direction in directions], axis=0)


def _vote(
    cylinder: Cylinder,
    sigma: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    planned_radii: Sequence[float],
) -> Cylinder | None:
    at = stations(cylinder, views, basis, CHUNK)
    at = at.select(visible(cylinder, others, views, at))
    if len(np.unique(at.view)) < 2 or len(np.unique(at.side)) < 2:
        return None
    at = at.select(np.arange(0, len(at), max(len(at) // 1500, 1)))
    pixel = 1.0 / float(np.median(at.gain))
    radius = cylinder.radius
    sideways = float(np.clip(3.0 * sigma, 2.0 * pixel, 0.4 * radius))
    thicker = float(np.clip(2.5 * sigma, 2.0 * pixel, 0.3 * radius))
    reach = np.array([sideways, sideways, sideways, sideways, thicker])
    furthest = min(float(at.half_width.max()) * WINDOW_OF_HALF_WIDTH, (sideways + thicker) * float(at.gain.max()))
    step = float(np.clip(np.median(at.half_width) / 16.0, 0.25, 1.0))
    offsets = np.arange(-np.ceil(furthest / step) - 2, np.ceil(furthest / step) + 3) * step
    response = responses(profiles(views, at, offsets, CHUNK // 2), offsets, at)
    near = [value - radius for value in planned_radii if abs(value - radius) < thicker]
    seeds = np.zeros((len(near), 5))
    seeds[:, 4] = near
    random = np.random.default_rng(0)
    best, _ = search(at, response, offsets, reach, seeds, random)
    return moved(cylinder, basis, best[0])


@dataclass(frozen=True)
class _Solution:
    step: FloatArray
    covariance: FloatArray
    view_offset: FloatArray
    used: NDArray[np.bool_]


def _fit(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder], basis: FloatArray) -> ContourFit | None:
    view_offset = np.zeros(len(views))
    for reach in (2.5, 1.5, 1.2, 1.2):
        at, edges = measure(cylinder, views, others, basis, view_offset, reach)
        if len(at) < 20:
            return None
        solution = _solve(at, edges, len(views))
        cylinder = moved(cylinder, basis, solution.step)
        view_offset = solution.view_offset
    length = cylinder.length
    mean = np.zeros((5, 5))
    mean[0:2, 0:2] = mean[0:2, 2:4] = 0.5 * np.eye(2)
    mean[2:4, 0:2] = -np.eye(2) / length
    mean[2:4, 2:4] = np.eye(2) / length
    mean[4, 4] = 1.0
    covariance = mean @ solution.covariance @ mean.T
    return ContourFit(
        cylinder,
        covariance,
        basis,
        float(np.sqrt(covariance[4, 4])),
        0.0,
        len(np.unique(at.view[solution.used])),
        float("nan"),
        float("nan"),
    )


def measure(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    reach: float,
) -> tuple[Stations, LimbEdges]:
    """Stations on the outlines and the edges within `reach` px of them."""
    at = stations(cylinder, views, basis, CHUNK, margin=INWARD)
    at = at.select(visible(cylinder, others, views, at))
    if not len(at):
        return at, LimbEdges(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    inward = min(INWARD, WINDOW_OF_HALF_WIDTH * float(np.median(at.half_width)))
    offsets = np.arange(-inward - reach, OUTWARD + 0.25, 0.5)
    values = profiles(views, at, offsets, CHUNK)
    return at, limb_edges(values, offsets, at.half_width, BLUR, reach)


def _solve(at: Stations, edges: LimbEdges, count: int) -> _Solution:
    """Robust least squares for the step (5,) with a sideways offset of each view as a random effect.

    A wrong pose moves both outlines of a view together, which says nothing about the radius: the offsets' variance is
    estimated from the views' scatter (expectation maximisation), so that with true poses they vanish.
    """
    jacobian = at.jacobian
    sign = np.where(at.side == 0, 1.0, -1.0)
    step = np.zeros(5)
    offset = np.zeros(count)
    variance = 0.25
    for _ in range(25):
        predicted = jacobian @ step + sign * offset[at.view]
        distance = np.where(np.isfinite(edges.offset), np.abs(edges.offset - predicted[:, None]), np.inf)
        nearest = np.argmin(distance, axis=1)
        rows = np.arange(len(at))
        used = np.isfinite(distance[rows, nearest]) & (edges.sigma[rows, nearest] < 0.7)
        seen = np.where(used, edges.offset[rows, nearest], 0.0)
        sigma = np.where(used, edges.sigma[rows, nearest], 1.0)
        residual = np.where(used, seen - predicted, 0.0)
        weight = used / (sigma**2 + FLOOR**2) / (1.0 + (residual / ROBUST) ** 2)
        weighted = jacobian * weight[:, None]
        own = np.bincount(at.view, weight, count) + 1.0 / variance
        cross = np.stack([np.bincount(at.view, sign * weighted[:, k], count) for k in range(5)], axis=1)
        right = np.bincount(at.view, sign * weight * seen, count)
        normal = weighted.T @ jacobian - (cross / own[:, None]).T @ cross
        normal += np.diag(np.full(5, 1e-9 * np.trace(normal)))
        step = np.linalg.solve(normal, weighted.T @ seen - cross.T @ (right / own))
        offset = (right - cross @ step) / own
        active = own > 2.0 / variance
        if active.any():
            variance = max(float(np.mean(offset[active] ** 2 + 1.0 / own[active])), 0.02**2)
    remaining = np.where(used, seen - jacobian @ step - sign * offset[at.view], 0.0)
    scores = np.stack([np.bincount(at.view, weighted[:, k] * remaining, count) for k in range(5)], axis=1)
    clusters = len(np.unique(at.view[used]))
    inverse = np.linalg.inv(normal)
    covariance = inverse @ (scores.T @ scores) @ inverse * clusters / max(clusters - 3, 1) + inverse
    model = (MODEL_ERROR / float(np.median(at.gain))) ** 2
    covariance = covariance + model * np.eye(5)
    return _Solution(step, covariance, offset, used)
