# SPDX-License-Identifier: Apache-2.0
"""Sub-pixel limb edges: a blurred model of the surface that curves away and of what lies behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray

# Half of the width of the limb model's window inside the pipe [px]: shading stays smooth so far.
INWARD = 8.0
# A line belongs to one side of the pipe only while it is nearer to it than to the axis (share of the half width).
WINDOW_OF_HALF_WIDTH = 0.8
# Step of the trial positions [px] (the minimum is refined by a parabola), and edges of one profile that are kept: limb,
# highlight and shadow.
TRIAL_STEP, MOST_EDGES = 0.1, 3
# Profiles that are compared with the model at a time: an array of 2 MB.
_BLOCK = 1024
# Share of Schlick's reflectance that a painted or a rough metal surface keeps at grazing incidence: between none (matt)
# and a half (gloss); the tests hold that either moves the edge by less than 0.09 px.
RIM = 0.25


def _linear_light() -> NDArray[np.float32]:
    """Table from the 256 grey levels of an sRGB image to light, scaled to 0 ... 255 (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    return (255.0 * np.where(level < 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)).astype(np.float32)


# Lens and pixel blur light, not grey levels: in grey levels a bright pipe before a dark wall looks 0.2 px too wide.
LINEAR_LIGHT = _linear_light()


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

    def displaced(self, by: FloatArray) -> LimbEdges:
        """The edges with all offsets of a profile moved by its value (N,) [px]."""
        return replace(self, offset=self.offset + by[:, None])


def limb_basis(x: FloatArray, half_width: float, blur: float) -> FloatArray:
    """Model (Q, 5 or 6) at outward distances x (Q,) px from a limb of apparent radius `half_width`, blurred by `blur`.

    Outside: a level and a slope; inside: a level, and the two components of a cylinder's normal, of which the one
    towards the viewer rises as the square root of the depth (Lambert shading of a circular section). At grazing
    incidence the surface reflects what lies just behind it (Fresnel, in Schlick's form): there the outside shows.
    On a thin pipe the window reaches across the highlight: one more even term bends the shading.
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
    """Whether the limb model's window spans the pipe's half."""
    return half_width * WINDOW_OF_HALF_WIDTH < INWARD


def limb_cost(
    values: FloatArray, offsets: FloatArray, half_width: FloatArray, blur: float, trials: FloatArray
) -> FloatArray:
    """What `limb_basis` at each trial position leaves of the values' squares (N, T).

    The model's levels follow by linear least squares (variable projection). Widths are grouped by 15 %, which moves the
    limb's shape by less than the noise.
    """
    cost = np.empty((len(values), len(trials)))
    total = np.einsum("ij,ij->i", values, values)
    group = np.round(np.log(np.maximum(half_width, 1.0)) / np.log(1.15)).astype(int)
    for key in np.unique(group):
        members = np.flatnonzero(group == key)
        width = float(np.exp(key * np.log(1.15)))
        onto = _limb_spaces(width, blur, tuple(offsets.tolist()), tuple(trials.tolist()))
        for block in np.array_split(members, -(-len(members) // _BLOCK)):
            part = (values[block] @ onto).reshape(len(block), len(trials), -1)
            cost[block] = total[block, None] - np.einsum("itk,itk->it", part, part)
    return np.maximum(cost, 0.0)


@lru_cache(maxsize=64)
def _limb_spaces(width: float, blur: float, offsets: tuple[float, ...], trials: tuple[float, ...]) -> FloatArray:
    """Orthonormal bases (Q, T * 5 or 6) of the limb model at offsets (Q,) px for each trial position (T,)."""
    grid = np.array(offsets)
    bases = [np.linalg.qr(limb_basis(grid - trial, width, blur))[0] for trial in trials]
    return np.asarray(np.concatenate(bases, axis=1), np.float64)


def smooth_cost(values: FloatArray, offsets: FloatArray, half_width: FloatArray) -> FloatArray:
    """What a polynomial with as many coefficients as the limb model leaves (N,)."""
    order = 6 if len(values) and _is_thin(float(np.median(half_width))) else 5
    smooth = np.linalg.qr(np.vander(offsets / np.abs(offsets).max(), order))[0]
    part = values @ smooth
    return np.maximum(np.einsum("ij,ij->i", values, values) - np.einsum("ij,ij->i", part, part), 1e-9)


def limb_edges(
    values: NDArray[np.floating],
    offsets: FloatArray,
    half_width: FloatArray,
    blur: float,
    reach: float,
) -> LimbEdges:
    """Edges within +-`reach` [px] of the origin of profiles `values` (N, Q) taken at `offsets` (Q,) [px].

    Local minima over the position of what the limb model leaves unexplained.
    """
    light: FloatArray = np.asarray(values, np.float64)
    trials = np.arange(-reach, reach + 0.5 * TRIAL_STEP, TRIAL_STEP, dtype=float)
    cost = limb_cost(light, offsets, half_width, blur, trials)
    return _minima(cost, smooth_cost(light, offsets, half_width), trials, len(offsets))


def _minima(cost: FloatArray, plain: FloatArray, trials: FloatArray, samples: int) -> LimbEdges:
    """The deepest local minima of cost (N, T) over trials (T,) [px], by parabolas; `plain` (N,): a smooth profile's."""
    step = trials[1] - trials[0]
    inner = cost[:, 1:-1]
    lowest = (inner <= cost[:, :-2]) & (inner < cost[:, 2:])
    ranked = np.where(lowest, inner, np.inf)
    order = np.argsort(ranked, axis=1, kind="stable")[:, :MOST_EDGES]
    rows = np.arange(len(cost))[:, None]
    found = np.isfinite(ranked[rows, order])
    before, at, after = cost[rows, order], cost[rows, order + 1], cost[rows, order + 2]
    curvature = np.maximum(before - 2.0 * at + after, 1e-12)
    shift = 0.5 * (before - after) / curvature
    variance = np.maximum(at - 0.25 * (before - after) * shift, 1e-9) / max(samples - 6, 1)
    offset = np.where(found, trials[order + 1] + shift * step, np.nan)
    sigma = np.where(found, step * np.sqrt(2.0 * variance / curvature), np.inf)
    explained = np.where(found, np.clip(1.0 - at / plain[:, None], 0.0, 1.0), 0.0)
    return LimbEdges(offset, sigma, explained)
