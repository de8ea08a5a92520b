"""Sub-pixel edges of limbs: a blurred model of the surface that curves away and of what lies behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeprog_detect.outline import Stations, stations, visible
from pipeprog_detect.pipe import Cylinder, FloatArray, View

# The limb model's window: inwards as far as shading stays smooth, outwards to where the next thing may begin [px].
INWARD, OUTWARD = 8.0, 3.0
# A line belongs to one side of the pipe only while it is nearer to it than to the axis.
WINDOW_OF_HALF_WIDTH = 0.8
# Blur of an unresized camera image, lens and pixel together [px]; the model's offset hardly depends on it.
BLUR = 0.5


def _linear_light() -> FloatArray:
    """Table from the 256 grey levels of an sRGB image to light, scaled to 0 ... 255 (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    return (255.0 * np.where(level < 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)).astype(np.float32)


# Lens and pixel blur light, not grey levels: in grey levels a bright pipe before a dark wall looks 0.2 px too wide.
LINEAR_LIGHT = _linear_light()


def profiles(views: Sequence[View], at: Stations, offsets: FloatArray, rows: int) -> FloatArray:
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
        feet = (pixel[:, None] + shifts[None, :, None] * tangent[:, None]).reshape(-1, 1, 2)
        where = feet + offsets[None, :, None] * np.repeat(normal, rows, axis=0)[:, None]
        size = np.array([view.camera.width, view.camera.height])
        low = np.clip(np.floor(where.min(axis=(0, 1))).astype(int) - 2, 0, size - 1)
        high = np.clip(np.ceil(where.max(axis=(0, 1))).astype(int) + 3, low + 1, size)
        light = cv2.LUT(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]), LINEAR_LIGHT)
        where = (where - low).astype(np.float32)
        sampled = cv2.remap(light, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
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
    """Model (Q, 5) at outward distances x (Q,) px from a limb of apparent radius `half_width`, blurred by `blur` px.

    Outside: a level and a slope; inside: a level, and the two components of a cylinder's normal, of which the one
    towards the viewer rises as the square root of the depth (Lambert shading of a circular section).
    """
    fine = 0.05
    reach = 4.0 * blur
    grid = np.arange(x.min() - reach, x.max() + reach + fine, fine)
    inside = np.clip(0.5 - grid / fine, 0.0, 1.0)
    depth = np.clip(-grid, 0.0, half_width) / half_width
    towards = np.sqrt(depth * (2.0 - depth))
    columns = np.stack([1.0 - inside, (1.0 - inside) * grid / 4.0, inside, inside * depth * half_width / 4.0, towards])
    half = int(np.ceil(reach / fine))
    taps = np.arange(-half, half + 1) * fine
    kernel = np.exp(-0.5 * (taps / blur) ** 2)
    kernel /= kernel.sum()
    blurred = [np.convolve(np.pad(column, len(kernel) // 2, mode="edge"), kernel, mode="valid") for column in columns]
    return np.stack([np.interp(x, grid, column) for column in blurred], axis=1)


def _projector(basis: FloatArray) -> FloatArray:
    return np.linalg.qr(basis)[0]


def limb_edges(
    values: FloatArray,
    offsets: FloatArray,
    half_width: FloatArray,
    blur: float,
    reach: float,
    step: float = 0.1,
    places: int = 3,
) -> LimbEdges:
    """Edges within +-`reach` px of the origin of profiles `values` (N, Q) taken at `offsets` (Q,) px.

    For every trial position the five levels of `limb_basis` follow by linear least squares; local minima of the
    remaining cost over the position are edges (variable projection). Widths are grouped by 15 %, which moves the
    limb's shape by less than the noise.
    """
    values = np.asarray(values, float)
    count = len(values)
    trials = np.arange(-reach, reach + 0.5 * step, step)
    cost = np.empty((count, len(trials)))
    total = np.einsum("ij,ij->i", values, values)
    group = np.round(np.log(np.maximum(half_width, 1.0)) / np.log(1.15)).astype(int)
    for key in np.unique(group):
        members = np.flatnonzero(group == key)
        width = float(np.exp(key * np.log(1.15)))
        for index, trial in enumerate(trials):
            onto = _projector(limb_basis(offsets - trial, width, blur))
            part = values[members] @ onto
            cost[members, index] = total[members] - np.einsum("ij,ij->i", part, part)
    smooth = _projector(np.vander(offsets / np.abs(offsets).max(), 5))
    part = values @ smooth
    plain = np.maximum(total - np.einsum("ij,ij->i", part, part), 1e-9)
    return _minima(np.maximum(cost, 0.0), plain, trials, places, len(offsets))


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


def outline_edges(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    reach: float,
    chunk: int,
) -> tuple[Stations, LimbEdges]:
    """Stations every `chunk` px on the predicted outlines and the edges near them.

    Each profile is the mean over its chunk; edges lie within `reach` px of where the sideways `view_offset` (V,) px of
    each view puts the outline. Stations behind one of the `others` are left out.
    """
    at = stations(cylinder, views, basis, chunk, margin=INWARD)
    at = at.select(visible(cylinder, others, views, at))
    if not len(at):
        return at, LimbEdges(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    inward = min(INWARD, WINDOW_OF_HALF_WIDTH * float(np.median(at.half_width)))
    offsets = np.arange(-inward - reach, OUTWARD + 0.25, 0.5)
    shift = sideways(at) * view_offset[at.view]
    values = profiles(views, replace(at, pixel=at.pixel + shift[:, None] * at.normal), offsets, chunk)
    edges = limb_edges(values, offsets, at.half_width, BLUR, reach)
    return at, replace(edges, offset=edges.offset + shift[:, None])
