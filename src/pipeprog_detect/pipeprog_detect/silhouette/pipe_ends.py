"""The ends of a pipe in the keyframes: the rim, seen on the unrolled barrel, where the outlines stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import hidden, project
from pipeprog_detect.silhouette.extension import Evidence, outline_evidence
from pipeprog_detect.silhouette.limb_edges import LINEAR_LIGHT
from pipeprog_detect.silhouette.occlusion import behind
from pipeprog_detect.types import Cylinder, View

# The barrel's part that faces the camera steeply enough to resolve lengths on it.
HALF_ARC, SECTORS, RAYS_PER_SECTOR = np.radians(70.0), 6, 4
# Samples for one pixel along the axis.
SAMPLES_PER_PIXEL = 2
# How many powers of e the places may be less probable than the best one by the outlines, and how many an edge all
# around is worth: the outlines tell the place to a few stations, the rim within them.
PLAUSIBLE, RIM_WORTH = 8.0, 25.0
# The edge of what hides the barrel is none of it: so many pixels beside it are left out.
BESIDE_HIDDEN = 4
# A rim's own edge is so many pixels wide.
BESIDE_RIM = 4
# What is hidden is no visible barrel: without a rim to show for it the pipe ends before it.
UNSEEN = 1.0
# Of two rims the inner one ends the barrel: an elbow or a collar has further rims outside.
OUTER_PENALTY = 0.3
# The cloud's surface mostly ends within so much of the barrel [m], but where it is torn (Cauchy).
SURFACE_SIGMA = 0.01
# It goes on over the end by half a stereo window [m], and into a bend of three radii by as much as that leaves the line
# within the surface's thickness [m].
FATTENED, THICKNESS = 0.02, 0.006


@dataclass(frozen=True)
class End:
    """Where a pipe ends: `position` outwards from the given end and its standard deviation [m].

    `odds`: logarithm of how much more probable the edges there are on a rim than beside one.
    """

    position: float
    sigma: float
    odds: float


def find_end(
    cylinder: Cylinder,
    at_end: bool,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
    surface_end: float | None,
) -> End | None:
    """The end of the straight barrel near the given one, or None where the images do not tell.

    The end is where the evidence of the outlines for the pipe is complete and where, on the barrel unrolled from each
    view by the known axis and radius, an edge lies across the axis at one position for all directions and views. The
    circle of the rim needs no conic that way: its projection is the unrolling itself. `surface_end` [m], outwards from
    the given end, is where the surface seen in the cloud ends, if it shows the pipe.
    """
    axis = cylinder.axis if at_end else -cylinder.axis
    end = cylinder.end if at_end else cylinder.start
    outside = max(0.15, 3.0 * cylinder.radius)
    inside = min(outside, 0.6 * cylinder.length)
    if surface_end is not None:
        inside = min(inside, FATTENED + float(np.sqrt(6.0 * cylinder.radius * THICKNESS)) - surface_end)
    evidence = outline_evidence(cylinder, at_end, outside, views, others, view_offset, blur)
    if evidence is None:
        return None
    position, odds = _odds(evidence, inside)
    if not len(odds) or int(np.argmax(odds)) == len(odds) - 1:
        return None
    distances = [np.linalg.norm(end - view.centre) for view in views]
    pixel = float(np.median(distances)) / views[0].camera.fx
    along = np.arange(-inside, outside, pixel / SAMPLES_PER_PIXEL, dtype=float)
    slopes = [_slopes(axis, end, cylinder.radius, along, view, others) for view in views]
    edges = np.concatenate(slopes) if slopes else np.zeros((0, len(along)))
    seen = np.isfinite(edges)
    if not seen.any():
        return None
    typical = float(np.median(np.abs(edges[seen])))
    strength = np.where(seen, np.abs(edges) / (np.abs(edges) + 2.0 * typical + 1e-9), 0.0)
    vote = _all_around(strength, seen)
    vote -= OUTER_PENALTY * np.maximum(along, 0.0) / outside
    if surface_end is not None:
        odds = odds - np.log1p(((position - surface_end) / SURFACE_SIGMA) ** 2)
    likely = np.interp(along, position, odds) - float(odds.max())
    score = np.where(likely > -PLAUSIBLE, likely + RIM_WORTH * vote, -np.inf)
    best = int(np.argmax(score))
    # A rim stands out among the edges across the barrel: beside another as strong nothing tells that this is it.
    elsewhere = np.abs(np.arange(len(vote)) - best) > BESIDE_RIM * SAMPLES_PER_PIXEL
    contrast = float(vote[best]) - max(float(vote[elsewhere].max(initial=0.0)), 0.0)
    return End(*_refined(strength, seen, along, best, pixel), RIM_WORTH * max(contrast, 0.0))


def _all_around(strength: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """How much stronger than elsewhere the edges (V * SECTORS, T) of all sectors are at each place (T,).

    Texture has edges in some sectors: the weaker half of them counts. Where nothing is seen it is 0.
    """
    count = seen.reshape(-1, SECTORS, seen.shape[1]).sum(axis=0)
    mean = strength.reshape(-1, SECTORS, seen.shape[1]).sum(axis=0) / (count + 1.0)
    vote = np.sort(mean, axis=0)[: SECTORS // 2].mean(axis=0)
    shown = count.min(axis=0) > 0
    return np.where(shown, vote - np.median(vote[shown]), 0.0) if shown.any() else np.zeros(len(vote))


def _odds(evidence: Evidence, inside: float) -> tuple[FloatArray, FloatArray]:
    """Places (M,) beyond `-inside` [m] and the logarithm of the odds, but for a constant, that the pipe ends there."""
    step = float(evidence.along[1] - evidence.along[0])
    place = np.append(evidence.along - 0.5 * step, evidence.along[-1] + 0.5 * step)
    total = np.append(0.0, np.cumsum(np.where(evidence.seen > 0, evidence.log_odds, -UNSEEN)))
    searched = place > -inside
    return place[searched], total[searched]


def _slopes(
    axis: FloatArray, end: FloatArray, radius: float, along: FloatArray, view: View, others: Sequence[Cylinder]
) -> FloatArray:
    """Derivative of the light along the axis (SECTORS, T) on the unrolled barrel; NaN outside the image or hidden."""
    towards = view.centre - end
    towards = towards - axis * (axis @ towards)
    towards = towards / np.linalg.norm(towards)
    angle = np.linspace(-HALF_ARC, HALF_ARC, SECTORS * RAYS_PER_SECTOR)
    radial = np.cos(angle)[:, None] * towards + np.sin(angle)[:, None] * np.cross(axis, towards)
    points = end + along[None, :, None] * axis + radius * radial[:, None]
    pixel, depth = project(view, points.reshape(-1, 3))
    camera = view.camera
    sharp = (
        (depth > 0.05) & (pixel > 2).all(axis=1) & (pixel[:, 0] < camera.width - 3) & (pixel[:, 1] < camera.height - 3)
    )
    there, deep = pixel[sharp], depth[sharp]
    sharp[sharp] = ~(hidden(view, there, deep, others) | behind(view, there, deep))
    inside = sharp.reshape(SECTORS, RAYS_PER_SECTOR, -1).all(axis=1)
    inside = minimum_filter1d(inside, 2 * BESIDE_HIDDEN * SAMPLES_PER_PIXEL + 1, axis=1)
    if not inside.any():
        return np.full(inside.shape, np.nan)
    low = np.maximum(np.floor(pixel[sharp].min(axis=0)).astype(int) - 2, 0)
    high = np.ceil(pixel[sharp].max(axis=0)).astype(int) + 3
    light = cv2.LUT(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]), LINEAR_LIGHT)
    where = (pixel - low).astype(np.float32).reshape(len(angle), len(along), 2)
    light = cv2.remap(light, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mean = light.reshape(SECTORS, RAYS_PER_SECTOR, -1).mean(axis=1, dtype=float)
    return np.where(inside, gaussian_filter1d(mean, SAMPLES_PER_PIXEL, axis=1, order=1), np.nan)


def _refined(strength: FloatArray, seen: FloatArray, along: FloatArray, best: int, pixel: float) -> tuple[float, float]:
    """The median of the peaks near sample `best` of each view, and its standard deviation [m]."""
    reach = 3 * SAMPLES_PER_PIXEL
    low, high = max(best - reach, 1), min(best + reach + 1, len(along) - 1)
    per_view = strength.reshape(-1, SECTORS, len(along)).sum(axis=1)
    whole = seen.reshape(-1, SECTORS, len(along))[:, :, low - 1 : high + 1].all(axis=2).sum(axis=1) >= SECTORS // 2
    places = []
    for row in per_view[whole]:
        peak = low + int(np.argmax(row[low:high]))
        bend = row[peak - 1] - 2.0 * row[peak] + row[peak + 1]
        shift = 0.5 * (row[peak - 1] - row[peak + 1]) / bend if bend < 0 else 0.0
        places.append(along[peak] + np.clip(shift, -0.5, 0.5) * (along[1] - along[0]))
    if not places:
        return float(along[best]), 2.0 * pixel
    position = float(np.median(places))
    scatter = 1.4826 * float(np.median(np.abs(np.array(places) - position)))
    return position, float(np.hypot(1.25 * scatter / np.sqrt(len(places)), 0.5 * pixel))
