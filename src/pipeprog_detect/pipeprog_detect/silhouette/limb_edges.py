"""Sub-pixel edges of limbs: a blurred model of the surface that curves away and of what lies behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import Stations, stations, visible
from pipeprog_detect.types import Cylinder, View

# The limb model's window: inwards as far as shading stays smooth; outwards, beyond the blur, to where the next thing
# may begin [px].
INWARD, OUTWARD, OUTWARD_OF_BLUR = 8.0, 1.5, 3.0
# A line belongs to one side of the pipe only while it is nearer to it than to the axis.
WINDOW_OF_HALF_WIDTH = 0.8
# Blur of a sharp image, lens and pixel together, and the ones that are tried [px].
SHARP = 0.5
BLURS = np.array([0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1, 2.5])
# Profiles that are compared with the model at a time: some megabytes.
_BLOCK = 1024
# Share of Schlick's reflectance that a painted or a rough metal surface keeps at grazing incidence.
RIM = 0.25


def _linear_light() -> NDArray[np.float32]:
    """Table from the 256 grey levels of an sRGB image to light, scaled to 0 ... 255 (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    return (255.0 * np.where(level < 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)).astype(np.float32)


# Lens and pixel blur light, not grey levels: in grey levels a bright pipe before a dark wall looks 0.2 px too wide.
LINEAR_LIGHT = _linear_light()


def profiles(views: Sequence[View], at: Stations, offsets: FloatArray, rows: int) -> NDArray[np.float32]:
    """Light (N, Q) float32, 0 ... 255, along the outward normals at `offsets` (Q,) px, the mean of `rows` such lines.

    Samples outside the image repeat its border.
    """
    result = np.empty((len(at), len(offsets)), np.float32)
    shifts = np.arange(rows) - 0.5 * (rows - 1)
    for index, view in enumerate(views):
        chosen = np.flatnonzero(at.view == index)
        if not len(chosen):
            continue
        pixel, normal = at.pixel[chosen], at.normal[chosen]
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        feet = (pixel[:, None] + shifts[None, :, None] * tangent[:, None]).reshape(-1, 2)
        outward = np.repeat(normal, rows, axis=0)
        size = np.array([view.camera.width, view.camera.height])
        tips = np.stack([feet + offsets[0] * outward, feet + offsets[-1] * outward])
        low = np.clip(np.floor(tips.min(axis=(0, 1))).astype(int) - 2, 0, size - 1)
        high = np.clip(np.ceil(tips.max(axis=(0, 1))).astype(int) + 3, low + 1, size)
        light = cv2.LUT(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]), LINEAR_LIGHT)
        along = offsets.astype(np.float32)
        x, y = (np.multiply.outer(outward[:, k].astype(np.float32), along) for k in (0, 1))
        x += (feet[:, :1] - low[0]).astype(np.float32)
        y += (feet[:, 1:] - low[1]).astype(np.float32)
        sampled = cv2.remap(light, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        result[chosen] = sampled.reshape(len(chosen), rows, -1).mean(axis=1, dtype=np.float32)
    return result


@dataclass(frozen=True)
class LimbEdges:
    """Edges along N profiles: `offset` (N, M) px outwards of the best M places, `cost` (N, M) and `sigma` (N, M) px.

    `explained` (N, M): share of what a smooth profile leaves unexplained that the edge explains, 0 to 1. Empty places
    are NaN with explained 0.
    """

    offset: FloatArray
    sigma: FloatArray
    explained: FloatArray


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


def _costs(
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


def _smooth_cost(values: FloatArray, offsets: FloatArray, half_width: FloatArray) -> FloatArray:
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
    step: float = 0.1,
    places: int = 3,
) -> LimbEdges:
    """Edges within +-`reach` px of the origin of profiles `values` (N, Q) taken at `offsets` (Q,) px.

    Local minima over the position of what the limb model leaves unexplained.
    """
    light: FloatArray = np.asarray(values, np.float64)
    trials = np.arange(-reach, reach + 0.5 * step, step, dtype=float)
    cost = _costs(light, offsets, half_width, blur, trials)
    return _minima(cost, _smooth_cost(light, offsets, half_width), trials, places, len(offsets))


def _minima(cost: FloatArray, plain: FloatArray, trials: FloatArray, places: int, samples: int) -> LimbEdges:
    """The `places` deepest local minima of cost (N, T) over trials (T,), by parabolas."""
    step = trials[1] - trials[0]
    inner = cost[:, 1:-1]
    lowest = (inner <= cost[:, :-2]) & (inner < cost[:, 2:])
    ranked = np.where(lowest, inner, np.inf)
    order = np.argsort(ranked, axis=1, kind="stable")[:, :places]
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


def sideways(at: Stations) -> FloatArray:
    """Sign (N,) of the outward displacement that a shift of the whole pipe towards side 0 causes."""
    return np.where(at.side == 0, 1.0, -1.0)


def outline_profiles(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    reach: float,
    blur: float,
    chunk: int,
    limit: int | None = None,
) -> tuple[Stations, FloatArray, FloatArray]:
    """Stations every `chunk` px on the predicted outlines, offsets (Q,) px and light (N, Q) around them.

    Each profile is the mean over its chunk and starts from where the sideways `view_offset` (V,) px of its view puts
    the outline. Stations behind one of the `others` are left out, and evenly so many that about `limit` remain.
    """
    at = stations(cylinder, views, basis, chunk, margin=INWARD)
    at = at.select(visible(cylinder, others, views, at))
    if limit is not None:
        at = at.select(np.arange(0, len(at), max(len(at) // limit, 1)))
    inward = INWARD
    if len(at):
        inward = min(INWARD, WINDOW_OF_HALF_WIDTH * float(np.median(at.half_width)))
    outward = OUTWARD + OUTWARD_OF_BLUR * blur
    offsets = np.arange(-inward - reach, outward + 0.25, 0.5, dtype=float)
    shift = sideways(at) * view_offset[at.view]
    values = profiles(views, replace(at, pixel=at.pixel + shift[:, None] * at.normal), offsets, chunk)
    return at, offsets, np.asarray(values, float)


def outline_edges(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    reach: float,
    blur: float,
    chunk: int,
    limit: int | None = None,
) -> tuple[Stations, LimbEdges]:
    """Stations as in `outline_profiles` and the edges (from the predicted outline) within `reach` px of them."""
    at, offsets, values = outline_profiles(cylinder, views, others, basis, view_offset, reach, blur, chunk, limit)
    edges = limb_edges(values, offsets, at.half_width, blur, reach)
    shift = sideways(at) * view_offset[at.view]
    return at, replace(edges, offset=edges.offset + shift[:, None])


def estimate_blur(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    chunk: int,
) -> float:
    """Blur of the images [px] by which the limb model explains the outlines best.

    Surfaces only soften an edge further: of the best values of all views and sides the lowest tenth counts.
    """
    reach = 0.8
    at, offsets, values = outline_profiles(cylinder, views, others, basis, view_offset, reach, 1.0, chunk, 600)
    if not len(at):
        return SHARP
    trials = np.arange(-reach, reach + 0.1, 0.2, dtype=float)
    left = [_costs(values, offsets, at.half_width, float(blur), trials).min(axis=1) for blur in BLURS]
    cost = np.log(np.stack(left) / _smooth_cost(values, offsets, at.half_width) + 1e-4)
    clear = cost.min(axis=0) < np.log(0.4)
    outline = 2 * at.view + at.side
    best = []
    for one in np.unique(outline[clear]):
        members = clear & (outline == one)
        if members.sum() >= 4:
            best.append(_lowest(np.log(BLURS), cost[:, members].sum(axis=1)))
    return float(np.exp(np.quantile(best, 0.1))) if len(best) >= 3 else SHARP


def _lowest(x: FloatArray, cost: FloatArray) -> float:
    """Where the parabola through the least of cost (T,) at x (T,) and its neighbours is lowest."""
    middle = int(np.clip(np.argmin(cost), 1, len(x) - 2))
    square, slope, _ = np.polyfit(x[middle - 1 : middle + 2], cost[middle - 1 : middle + 2], 2)
    return float(np.clip(-0.5 * slope / square, x[0], x[-1])) if square > 0 else float(x[np.argmin(cost)])
