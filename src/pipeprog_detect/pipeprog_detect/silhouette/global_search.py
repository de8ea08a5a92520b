"""Which cylinder the edges of all views agree on: an exhaustive vote, so that no single strong edge decides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.stats import qmc

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import Stations
from pipeprog_detect.silhouette.limb_edges import WINDOW_OF_HALF_WIDTH, profiles
from pipeprog_detect.types import View


def vote(
    views: Sequence[View],
    at: Stations,
    reach: FloatArray,
    furthest: float,
    half_chunk: int,
    seeds: FloatArray | None = None,
) -> FloatArray:
    """Steps (E, 5) of `outline.moved` within +-`reach` (5,) [m] that most edges of all views support, best first.

    `at`: the outlines before the step, which moves them by `furthest` [px] at most. `seeds` (S, 5) are tried, too.
    """
    furthest = min(float(at.half_width.max()) * WINDOW_OF_HALF_WIDTH, furthest)
    spacing = float(np.clip(np.median(at.half_width) / 16.0, 0.25, 1.0))
    offsets = np.arange(-np.ceil(furthest / spacing) - 2, np.ceil(furthest / spacing) + 3) * spacing
    response = responses(profiles(views, at, offsets, half_chunk), offsets, at)
    none = np.zeros((0, 5))
    return search(at, response, offsets, reach, none if seeds is None else seeds, np.random.default_rng(0))


def responses(values: NDArray[np.floating], offsets: FloatArray, at: Stations) -> NDArray[np.float32]:
    """Peaks of the gradient along profiles `values` (N, Q): (N, Q) float32, 0 where none, up to 1 for a clear one.

    Strength saturates at the median of all peaks: where a shadow's edge is ten times stronger than the outline, both
    count about alike, and agreement over the views decides between them.
    """
    slope = np.abs(gaussian_filter1d(np.asarray(values, float), 0.7 / (offsets[1] - offsets[0]), axis=1, order=1))
    inner = slope[:, 1:-1]
    peak = (inner >= slope[:, :-2]) & (inner > slope[:, 2:])
    peak &= np.abs(offsets[None, 1:-1]) <= WINDOW_OF_HALF_WIDTH * at.half_width[:, None]
    result = np.zeros(values.shape, np.float32)
    if peak.any():
        typical = np.median(inner[peak])
        result[:, 1:-1] = np.where(peak, inner / (inner + typical + 1e-9), 0.0)
    return result


def smeared(response: NDArray[np.float32], offsets: FloatArray, at: Stations, width: float) -> NDArray[np.float32]:
    """Responses (N, Q) spread by a triangle of half-width `width` px and made neutral: mean 0 inside each window."""
    step = offsets[1] - offsets[0]
    taps = np.arange(-int(width / step), int(width / step) + 1) * step
    result = np.zeros_like(response)
    for tap in taps:
        shift = round(tap / step)
        part = np.roll(response, shift, axis=1) * np.float32(1.0 - abs(tap) / (width + step))
        np.maximum(result, part, out=result)
    window = np.abs(offsets[None]) <= WINDOW_OF_HALF_WIDTH * at.half_width[:, None]
    mean = (result * window).sum(axis=1) / np.maximum(window.sum(axis=1), 1)
    return np.where(window, result - mean[:, None], np.float32(0.0)).astype(np.float32)


@njit(cache=True)
def _scores(
    steps: FloatArray, jacobian: FloatArray, response: NDArray[np.float32], first: float, step: float
) -> FloatArray:
    """Sum over stations of the response at the displacement that each step (M, 5) causes there."""
    result = np.zeros(len(steps))
    last = response.shape[1] - 1
    for m in range(len(steps)):
        total = 0.0
        for n in range(len(jacobian)):
            offset = 0.0
            for k in range(5):
                offset += steps[m, k] * jacobian[n, k]
            place = (offset - first) / step
            if place >= 0.0 and place < last:
                below = int(place)
                part = place - below
                total += response[n, below] * (1.0 - part) + response[n, below + 1] * part
        result[m] = total
    return result


def search(
    at: Stations,
    response: NDArray[np.float32],
    offsets: FloatArray,
    reach: FloatArray,
    seeds: FloatArray,
    random: np.random.Generator,
    elites: int = 96,
    offspring: int = 32,
) -> FloatArray:
    """Best steps (E, 5) within +-`reach` (5,) [m], best first.

    A Sobol grid over the whole box is scored against widely smeared edges; the best are spread again and again with
    half the step and half the smear (annealing) down to a third of a pixel. `seeds` (S, 5) join the first grid.
    """
    gain = float(np.median(at.gain))
    half_width = float(np.median(at.half_width))
    grid = qmc.Sobol(5, seed=random).random(8192) * 2.0 - 1.0
    population = np.concatenate([np.zeros((1, 5)), seeds, grid * reach])
    outlines = np.stack([at.jacobian[at.side == side].mean(axis=0) for side in (0, 1)], axis=1)
    width = max(0.12 * half_width, 1.0)
    spread = 0.2 * reach
    first, step = float(offsets[0]), float(offsets[1] - offsets[0])
    while True:
        smear = smeared(response, offsets, at, width)
        score = _scores(population, at.jacobian, smear, first, step)
        order = np.argsort(-score, kind="stable")
        population = population[order[_niched(population[order] @ outlines, elites)]]
        if spread.max() * gain < 0.2:
            return population
        cloud = random.normal(size=(len(population), offspring, 5)) * spread
        children = np.clip(population[:, None] + cloud, -reach, reach).reshape(-1, 5)
        population = np.concatenate([population, children])
        spread = 0.6 * spread
        width = max(0.6 * width, 1.0)


def _niched(displacement: FloatArray, count: int, cell: float = 2.0, crowd: int = 16) -> NDArray[np.int64]:
    """Indices of the first `count` of displacements (M, 2) px with no more than `crowd` in one cell of `cell` px.

    Keeps rival hypotheses alive, such as an outline and a shadow's edge beside it, until sub-pixel edges decide.
    """
    place = np.round(displacement / cell).astype(np.int64)
    _, cells = np.unique(place, axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    ordered = cells.ravel()[order]
    first = np.r_[0, np.flatnonzero(np.diff(ordered)) + 1]
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(first, np.diff(np.r_[first, len(order)]))
    return np.flatnonzero(rank < crowd)[:count]


def distinct(population: FloatArray, at: Stations, apart: float, limit: int) -> FloatArray:
    """The first steps (K <= limit, 5) of a population, best first, whose outlines differ by `apart` px rms or more."""
    displaced = population @ at.jacobian.T
    kept: list[int] = []
    for index in range(len(population)):
        if all(np.sqrt(np.mean((displaced[index] - displaced[other]) ** 2)) >= apart for other in kept):
            kept.append(index)
        if len(kept) == limit:
            break
    return population[kept]
