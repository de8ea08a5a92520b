# SPDX-License-Identifier: Apache-2.0
"""Sub-pixel limb edges: a blurred model of the surface that curves away and of what lies behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray

# Half of the width of the limb model's window inside the pipe [px]: shading stays smooth so far.
INWARD = 8.0
# A line belongs to one side of the pipe only while it is nearer to it than to the axis (share of the half width).
WINDOW_OF_HALF_WIDTH = 0.8
# Step of the trial positions [px] (the minimum is refined by a parabola), and edges of one profile that are kept: limb,
# highlight and shadow.
TRIAL_STEP, MOST_EDGES = 0.1, 3
# Widths are grouped by 15 %, which moves the limb's shape by less than the noise.
WIDTH_STEP = float(np.log(1.15))
# Share of Schlick's reflectance that a painted or a rough metal surface keeps at grazing incidence: between none (matt)
# and a half (gloss); the tests hold that either moves the edge by less than 0.09 px.
RIM = 0.25
# Prior of the model's slopes and shading, in steps between its two levels: standard deviation of what the model leaves
# unexplained, and of a coefficient, which is some steps at the most (a slope, over 4 px). On a thin pipe the curves of
# the shading are nearly one: free coefficients of ten steps and more cancel each other and move the edge by up to a
# pixel. There a coefficient is held to a third of a step.
UNEXPLAINED, SHADING, THIN_SHADING = 0.05, 1.5, 0.3
# Thin is a pipe of which the window holds less than this [px]. Within twice as much a blurred edge and the shading are
# told apart: held as tightly there, the dark side of a DN65, which ends in its own shadow without a step, was taken
# for a step 0.3 px inside of the pipe (640 x 480 px at 2 m, half width 8.4 px).
THIN_WINDOW = 4.0


@dataclass(frozen=True)
class Profiles:
    """Light across the contour at N samples: `light` (N, Q), 0 to 255, at `offsets` (Q,) outwards [px]."""

    offsets: FloatArray
    light: NDArray[np.floating]


@dataclass(frozen=True)
class LimbEdges:
    """Up to M edges along each of N profiles, the best first.

    Attributes:
        offset: position (N, M) outwards [px], NaN where there is no such edge.
        sigma: its standard deviation (N, M) [px], infinite where there is no edge.
        explained: share (N, M), 0 to 1, of what a smooth profile leaves unexplained that the edge explains.
    """

    offset: FloatArray
    sigma: FloatArray
    explained: FloatArray

    def select(self, keep: NDArray[np.bool_]) -> LimbEdges:
        """Those of the profiles that a mask (N,) names."""
        return LimbEdges(self.offset[keep], self.sigma[keep], self.explained[keep])

    def displaced(self, by: FloatArray) -> LimbEdges:
        """The edges with all offsets of a profile moved by its value (N,) [px]."""
        return replace(self, offset=self.offset + by[:, None])


def limb_basis(x: FloatArray, half_width: float, blur: float) -> FloatArray:
    """Model (Q, 5 or 6) at outward distances x (Q,) px from a limb of apparent radius `half_width`, blurred by `blur`.

    Outside: a level and a slope; inside (from column 2 on): a level, and the two components of a cylinder's normal, of
    which the one towards the viewer rises as the square root of the depth (Lambert shading of a circular section). At
    grazing incidence the surface reflects what lies just behind it (Fresnel, in Schlick's form): there the outside
    shows. On a thin pipe the window reaches across the highlight: one more even term bends the shading.
    """
    grid, columns = _limb_table(half_width, blur, float(np.ceil(np.abs(x).max())))
    return np.stack([np.interp(x, grid, column) for column in columns], axis=1)


@lru_cache(maxsize=256)
def _limb_table(half_width: float, blur: float, extent: float) -> tuple[FloatArray, FloatArray]:
    """Distances (G,) within +-`extent` and the model's blurred columns (5 or 6, G) there."""
    fine = 0.05
    reach = int(np.ceil(4.0 * blur / fine))
    count = round(extent / fine) + reach
    grid = np.arange(-count, count + 1) * fine
    inside = np.clip(0.5 - grid / fine, 0.0, 1.0)
    depth = np.maximum(-grid / half_width, 0.0)
    near = np.minimum(depth, 1.0)
    towards = np.sqrt(near * (2.0 - near))
    mirrored = RIM * (1.0 - towards) ** 5 * inside
    body = inside - mirrored
    columns = [1.0 - body, (1.0 - inside) * grid / 4.0, body, body * near * half_width / 4.0, body * towards]
    if _is_thin(half_width):
        columns.append(body * depth**2)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * fine / blur) ** 2)
    kernel /= kernel.sum()
    blurred: FloatArray = np.stack([np.convolve(column, kernel, mode="valid") for column in columns])
    return np.asarray(grid[reach : len(grid) - reach], float), blurred


def _is_thin(half_width: float) -> bool:
    """Whether the limb model's window is too narrow for its shading to be told freely."""
    return half_width * WINDOW_OF_HALF_WIDTH < THIN_WINDOW


def prior_precision(half_width: float) -> FloatArray:
    """Precision (5 or 6,) of the prior of the coefficients of `limb_basis`, in one sample's; 0 for the levels."""
    thin = _is_thin(half_width)
    return _shade_precision(thin) * np.array([0.0, 1.0, 0.0, 1.0, 1.0, 1.0])[: _order(thin)]


def _order(thin: bool) -> int:
    """Number of columns of the limb model."""
    return 6 if thin else 5


def _shade_precision(thin: bool) -> float:
    """Precision of the prior of one coefficient of slopes and shading, in those of one sample."""
    return float((UNEXPLAINED / (THIN_SHADING if thin else SHADING)) ** 2)


@dataclass(frozen=True)
class _Models:
    """Models of profiles of Q offsets as `_space` has them, for T trial positions of a limb, for each group of widths.

    Attributes:
        limbs: (G, Q, 6 * T) float32: column k * T + t is the k-th of the model at trial t (`limb_basis`); 0 if none.
        smooth: (Q, 5 or 6) float32: a polynomial with as many coefficients as the limb model of the median width, and
            with as strong a prior.
        group: (N,) of each profile.
    """

    limbs: NDArray[np.float32]
    smooth: NDArray[np.float32]
    group: IntArray

    @classmethod
    def of(cls, half_width: FloatArray, blur: float, offsets: FloatArray, trials: FloatArray) -> _Models:
        """For profiles at offsets (Q,) [px] of pipes of `half_width` (N,) [px]."""
        keys, group = np.unique(np.round(np.log(np.maximum(half_width, 1.0)) / WIDTH_STEP), return_inverse=True)
        at, positions = tuple(offsets.tolist()), tuple(trials.tolist())
        limbs = [_limb_spaces(float(np.exp(key * WIDTH_STEP)), blur, at, positions) for key in keys]
        smooth = _smooth_space(_is_thin(float(np.median(half_width))), at)
        return cls(np.stack(limbs), smooth, group.astype(np.int64))


@lru_cache(maxsize=1024)
def _limb_spaces(
    width: float, blur: float, offsets: tuple[float, ...], trials: tuple[float, ...]
) -> NDArray[np.float32]:
    """Spaces (Q, 6 * T) of the limb model at offsets (Q,) px for each trial position (T,)."""
    away = np.subtract.outer(np.array(trials), np.array(offsets))
    model = limb_basis(-away.ravel(), width, blur).reshape(*away.shape, -1)
    basis = np.zeros((len(offsets), 6, len(trials)), np.float32)
    basis[:, : model.shape[2]] = _space(model, prior_precision(width)).transpose(1, 2, 0)
    return basis.reshape(len(offsets), -1)


@lru_cache(maxsize=256)
def _smooth_space(thin: bool, offsets: tuple[float, ...]) -> NDArray[np.float32]:
    """Space (Q, 5 or 6) of polynomials at offsets (Q,) px; all powers but the level have the prior of the shading."""
    at = np.array(offsets)
    powers = np.vander(at / np.abs(at).max(), _order(thin), increasing=True)
    precision = np.full(_order(thin), _shade_precision(thin))
    precision[0] = 0.0
    return np.ascontiguousarray(_space(powers, precision), np.float32)


def _space(models: FloatArray, precision: FloatArray) -> FloatArray:
    """Vectors (..., Q, K) for models (..., Q, K): a profile's squares less those of its products with them is its cost.

    That is the least sum of the squares of the residuals and, times their `precision` (K,), of the coefficients (ridge
    regression, Hoerl and Kennard 1970): the prior is further rows of the model, where the profile is 0.
    """
    rows = np.broadcast_to(np.diag(np.sqrt(precision)), (*models.shape[:-2], len(precision), len(precision)))
    basis: FloatArray = np.linalg.qr(np.concatenate([models, rows], axis=-2))[0][..., : models.shape[-2], :]
    return basis


def least_cost(
    values: NDArray[np.floating], offsets: FloatArray, half_width: FloatArray, blur: float, trials: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the limb model, at the best of the trial positions (T,), and a smooth profile leave of the squares (N,)."""
    if not len(values):
        return np.zeros(0), np.zeros(0)
    cost, plain = _unexplained(values, offsets, half_width, blur, trials)
    return cost.min(axis=1).astype(np.float64), plain.astype(np.float64)


def limb_edges(
    values: NDArray[np.floating], offsets: FloatArray, half_width: FloatArray, blur: float, reach: float
) -> LimbEdges:
    """Edges within +-`reach` [px] of the origin of profiles `values` (N, Q) taken at `offsets` (Q,) [px].

    Local minima over the position of what the limb model leaves unexplained.
    """
    trials = np.arange(-reach, reach + 0.5 * TRIAL_STEP, TRIAL_STEP, dtype=float)
    if not len(values):
        return LimbEdges(*(np.zeros((0, MOST_EDGES)) for _ in range(3)))
    cost, plain = _unexplained(values, offsets, half_width, blur, trials)
    return LimbEdges(*_minima(cost, plain, trials, max(len(offsets) - 6, 1), MOST_EDGES))


def _unexplained(
    values: NDArray[np.floating], offsets: FloatArray, half_width: FloatArray, blur: float, trials: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the limb model at each trial position (N, T), and a smooth profile (N,), leave of the profiles' squares."""
    models = _Models.of(half_width, blur, offsets, trials)
    light = np.ascontiguousarray(values, np.float32)
    return _costs(light, models.group, models.limbs, models.smooth, len(trials))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _costs(
    values: NDArray[np.float32],
    group: IntArray,
    limbs: NDArray[np.float32],
    smooth: NDArray[np.float32],
    trials: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See `_unexplained`.

    The model's levels follow by linear least squares (variable projection). Each profile's mean, which both models
    hold, is removed first, so that float32 suffices: what is left is the contrast alone.
    """
    count, width = values.shape
    cost = np.empty((count, trials), np.float32)
    plain = np.empty(count, np.float32)
    centred = np.empty(width, np.float32)
    onto = np.empty(limbs.shape[2], np.float32)
    for i in range(count):
        mean = np.float32(0.0)
        for j in range(width):
            mean += values[i, j]
        mean /= np.float32(width)
        total = np.float32(0.0)
        for j in range(width):
            centred[j] = values[i, j] - mean
            total += centred[j] * centred[j]
        onto[:] = np.float32(0.0)
        for j in range(width):
            level = centred[j]
            row = limbs[group[i], j]
            for k in range(len(row)):
                onto[k] += level * row[k]
        for t in range(trials):
            cost[i, t] = total
        for k in range(len(onto) // trials):
            for t in range(trials):
                cost[i, t] -= onto[k * trials + t] * onto[k * trials + t]
        for t in range(trials):
            cost[i, t] = max(cost[i, t], np.float32(0.0))
        for k in range(smooth.shape[1]):
            part = np.float32(0.0)
            for j in range(width):
                part += centred[j] * smooth[j, k]
            total -= part * part
        plain[i] = max(total, np.float32(1e-9))
    return cost, plain


@njit(cache=True, nogil=True)
def _minima(
    cost: NDArray[np.float32], plain: NDArray[np.float32], trials: FloatArray, freedom: int, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offset [px], sigma [px], explained share (N, M) of the `most` deepest local minima of cost (N, T), by parabolas.

    `plain` (N,): what a smooth profile leaves; `freedom`: degrees of freedom of what a limb leaves.
    """
    count = len(cost)
    offset = np.full((count, most), np.nan)
    sigma = np.full((count, most), np.inf)
    explained = np.zeros((count, most))
    step = trials[1] - trials[0]
    place = np.empty(most, np.int64)
    for i in range(count):
        row = cost[i]
        found = 0
        for t in range(1, len(row) - 1):
            if not (row[t] <= row[t - 1] and row[t] < row[t + 1]):
                continue
            if found < most:
                found += 1
            elif row[t] >= row[place[most - 1]]:
                continue
            rank = found - 1
            while rank > 0 and row[t] < row[place[rank - 1]]:
                place[rank] = place[rank - 1]
                rank -= 1
            place[rank] = t
        for m in range(found):
            before, at, after = float(row[place[m] - 1]), float(row[place[m]]), float(row[place[m] + 1])
            curvature = max(before - 2.0 * at + after, 1e-12)
            shift = 0.5 * (before - after) / curvature
            variance = max(at - 0.25 * (before - after) * shift, 1e-9) / freedom
            offset[i, m] = trials[place[m]] + shift * step
            sigma[i, m] = step * np.sqrt(2.0 * variance / curvature)
            explained[i, m] = min(max(1.0 - at / plain[i], 0.0), 1.0)
    return offset, sigma, explained
