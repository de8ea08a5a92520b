# SPDX-License-Identifier: Apache-2.0
"""Which cylinder the edges of all views agree on: a search of the whole range, so that no strong edge decides alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.limb_edges import WINDOW_OF_HALF_WIDTH, Profiles

# Samples that the search scores; more only take longer.
MOST_SAMPLES = 1500
# Steps of the first round (a power of two, as Sobol's sequence wants), and those that survive a round and spread anew.
FIRST_ROUND, ELITES, OFFSPRING = 8192, 96, 32
# Half-width of the smeared edges in the first round, as a share of the pipe's half-width, and their least one [px].
FIRST_SMEAR, LEAST_SMEAR = 0.12, 1.0
# Spread of the offspring in the second round, as a share of the range, and its decrease from round to round. It ends
# below a fifth of a pixel: sub-pixel edges tell what is left.
FIRST_SPREAD, DECREASE, LAST_SPREAD = 0.2, 0.6, 0.2
# Rivals are kept alive: no more survivors than this move the contour into the same cell of this size [px].
CROWD, CELL = 16, 2.0


def best_steps(
    samples: ContourSamples,
    profiles: Profiles,
    reach: FloatArray,
    seeds: FloatArray | None = None,
    tilt: float = np.inf,
) -> FloatArray:
    """Steps (E, 5) of `Scene.moved` within +-`reach` (5,) [m] that most edges of all views support, best first.

    Args:
        samples: of the contour before the step; `MOST_SAMPLES` suffice.
        profiles: the light around them, as far as the steps move them.
        reach: range of each component of the step.
        seeds: further steps (S, 5) that are tried, none of which tilts.
        tilt: by how much more than its start the end may move away from the cameras or towards them [m].
    """
    response = _responses(profiles, samples)
    tried = np.zeros((0, 5)) if seeds is None else seeds
    if tilt >= reach[3]:
        return _annealed(samples, response, profiles.offsets, reach, tried)
    # The end moves with the start, and by the tilt beside: the search need not look where only one of them moves far.
    jacobian = samples.jacobian.copy()
    jacobian[:, 1] += jacobian[:, 3]
    reach = np.array([*reach[:3], tilt, reach[4]])
    steps = _annealed(replace(samples, jacobian=jacobian), response, profiles.offsets, reach, tried)
    steps[:, 3] += steps[:, 1]
    return steps


def _responses(profiles: Profiles, samples: ContourSamples) -> NDArray[np.float32]:
    """Peaks of the gradient along profiles (N, Q): (N, Q) float32, 0 where none, up to 1 for a clear one.

    Strength saturates at the median of all peaks: a shadow's edge ten times stronger than the contour's counts about
    the same, and agreement over the views decides between them.
    """
    values, offsets = np.asarray(profiles.light, float), profiles.offsets
    slope = np.abs(gaussian_filter1d(values, 0.7 / (offsets[1] - offsets[0]), axis=1, order=1))
    inner = slope[:, 1:-1]
    peak = (inner >= slope[:, :-2]) & (inner > slope[:, 2:])
    peak &= np.abs(offsets[None, 1:-1]) <= WINDOW_OF_HALF_WIDTH * samples.half_width[:, None]
    result = np.zeros(values.shape, np.float32)
    if peak.any():
        typical = np.median(inner[peak])
        result[:, 1:-1] = np.where(peak, inner / (inner + typical + 1e-9), 0.0)
    return result


def _smeared(
    response: NDArray[np.float32], offsets: FloatArray, samples: ContourSamples, width: float
) -> NDArray[np.float32]:
    """Responses (N, Q) spread by a triangle of half-width `width` [px], with mean 0 inside each window."""
    step = offsets[1] - offsets[0]
    taps = np.arange(-int(width / step), int(width / step) + 1) * step
    result = np.zeros_like(response)
    for tap in taps:
        shift = round(tap / step)
        part = np.roll(response, shift, axis=1) * np.float32(1.0 - abs(tap) / (width + step))
        np.maximum(result, part, out=result)
    window = np.abs(offsets[None]) <= WINDOW_OF_HALF_WIDTH * samples.half_width[:, None]
    mean = (result * window).sum(axis=1) / np.maximum(window.sum(axis=1), 1)
    return np.where(window, result - mean[:, None], np.float32(0.0)).astype(np.float32)


def _scores(
    steps: FloatArray, jacobian: FloatArray, response: NDArray[np.float32], first: float, step: float
) -> FloatArray:
    """Sum over samples of the response (N, Q) at the displacement that each step (M, 5) causes there (M,)."""
    places = np.vstack([steps.T / step, np.full(len(steps), -first / step)])
    moves = np.hstack([jacobian, np.ones((len(jacobian), 1))])
    return _summed(places.T.astype(np.float32), np.ascontiguousarray(moves.T, np.float32), response)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _summed(steps: NDArray[np.float32], moves: NDArray[np.float32], response: NDArray[np.float32]) -> FloatArray:
    """Sum (M,) over samples of the response (N, Q) at the place `steps` (M, 6) @ `moves` (6, N); 0 beside it."""
    result = np.zeros(len(steps))
    count, width = response.shape
    place = np.empty(count, np.float32)
    flat = response.ravel()
    for m in range(len(steps)):
        s0, s1, s2, s3, s4, s5 = steps[m]
        for n in range(count):
            place[n] = s0 * moves[0, n] + s1 * moves[1, n] + s2 * moves[2, n] + s3 * moves[3, n] + s4 * moves[4, n] + s5
        total = np.float32(0.0)
        for n in range(count):
            if place[n] >= 0.0 and place[n] < width - 1:
                below = int(place[n])
                part = place[n] - np.float32(below)
                left = flat[n * width + below]
                total += left + part * (flat[n * width + below + 1] - left)
        result[m] = total
    return result


@cache
def _grid() -> FloatArray:
    """`FIRST_ROUND` points (M, 5) of Sobol's sequence, all over the range from -1 to 1 in each dimension."""
    from scipy.stats import qmc  # here, since its import takes half a second, in processes that never search, too

    return np.asarray(qmc.Sobol(5, seed=0).random(FIRST_ROUND) * 2.0 - 1.0)


def _annealed(
    samples: ContourSamples, response: NDArray[np.float32], offsets: FloatArray, reach: FloatArray, seeds: FloatArray
) -> FloatArray:
    """Best steps (E, 5) within +-`reach` (5,) [m], best first.

    Points of Sobol's sequence all over the range, and the `seeds` (S, 5), are scored against widely smeared edges; the
    best spread again and again, less from round to round, over edges that are smeared less (annealing).
    """
    random = np.random.default_rng(0)
    gain = float(np.median(samples.gain))
    half_width = float(np.median(samples.half_width))
    population = np.concatenate([np.zeros((1, 5)), seeds, _grid() * reach])
    lines = np.stack([samples.jacobian[samples.side == side].mean(axis=0) for side in np.unique(samples.side)], axis=1)
    width = max(FIRST_SMEAR * half_width, LEAST_SMEAR)
    spread = FIRST_SPREAD * reach
    first, step = float(offsets[0]), float(offsets[1] - offsets[0])
    while True:
        smear = _smeared(response, offsets, samples, width)
        score = _scores(population, samples.jacobian, smear, first, step)
        order = np.argsort(-score, kind="stable")
        population = population[order[_survivors(population[order] @ lines)]]
        if spread.max() * gain < LAST_SPREAD:
            return population
        scatter = random.normal(size=(len(population), OFFSPRING, 5)) * spread
        children = np.clip(population[:, None] + scatter, -reach, reach).reshape(-1, 5)
        population = np.concatenate([population, children])
        spread = DECREASE * spread
        width = max(DECREASE * width, LEAST_SMEAR)


@njit(cache=True, nogil=True)
def _survivors(displacement: FloatArray) -> NDArray[np.int64]:
    """Indices of the first `ELITES` of displacements (M, sides) [px] with no more than `CROWD` in one cell.

    Keeps rivals alive, such as a contour and a shadow's edge beside it, until sub-pixel edges decide.
    """
    count, sides = displacement.shape
    cells = np.empty((ELITES, sides), np.int64)
    crowd = np.zeros(ELITES, np.int64)
    kept = np.empty(ELITES, np.int64)
    known = alive = 0
    place = np.empty(sides, np.int64)
    for index in range(count):
        for side in range(sides):
            place[side] = round(displacement[index, side] / CELL)
        cell = 0
        while cell < known and (cells[cell] != place).any():
            cell += 1
        if cell == known:
            cells[cell] = place
            known += 1
        if crowd[cell] < CROWD:
            crowd[cell] += 1
            kept[alive] = index
            alive += 1
            if alive == ELITES:
                break
    return kept[:alive]


def distinct(steps: FloatArray, samples: ContourSamples, apart: float, limit: int) -> FloatArray:
    """The first steps (K <= limit, 5), best first, whose contours differ by `apart` [px] rms or more."""
    displaced = steps @ samples.jacobian.T
    kept: list[int] = []
    for index in range(len(steps)):
        if all(np.sqrt(np.mean((displaced[index] - displaced[other]) ** 2)) >= apart for other in kept):
            kept.append(index)
        if len(kept) == limit:
            break
    return steps[kept]
