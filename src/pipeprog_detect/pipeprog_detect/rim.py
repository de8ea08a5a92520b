"""The ends of a pipe in the keyframes: the rim, seen on the unrolled barrel, where the outlines stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pipeprog_detect.edges import LINEAR_LIGHT, outline_edges
from pipeprog_detect.outline import camera_centre, project
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.support import hits, support_profile

# The barrel's part that faces the camera steeply enough to resolve lengths on it.
HALF_ARC, SECTORS, RAYS_PER_SECTOR = np.radians(70.0), 6, 4
# Samples for one pixel along the axis.
SAMPLES_PER_PIXEL = 2
# The outlines must stop: from inside the end to outside their support (0 to 1) falls by so much, or, where little of
# the pipe can be told from its background, by this share of it; so much support is chance.
MIN_FALL, MIN_SHARE, CHANCE = 0.3, 0.45, 0.1
MIN_SEEN = 14
# A rim at the edge of the searched range needs so much more of a score than one at the given end; and of two the inner
# one ends the barrel: an elbow or a collar has further rims outside.
FAR_PENALTY, OUTER_PENALTY = 0.3, 0.3


@dataclass(frozen=True)
class End:
    """Where a pipe ends: `position` outwards from the given end and its standard deviation [m]."""

    position: float
    sigma: float


def find_end(
    cylinder: Cylinder,
    at_end: bool,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    blur: float,
) -> End | None:
    """The end of the straight barrel near the given one, or None where the images do not tell.

    The end is where the support of the outlines falls and where, on the barrel unrolled from each view by the known
    axis and radius, an edge lies across the axis at one position for all directions and views. The circle of the rim
    needs no conic that way: its projection is the unrolling itself.
    """
    axis = cylinder.axis if at_end else -cylinder.axis
    end = cylinder.end if at_end else cylinder.start
    outside = max(0.15, 3.0 * cylinder.radius)
    inside = min(outside, 0.6 * cylinder.length)
    distances = [np.linalg.norm(end - camera_centre(view)) for view in views]
    pixel = float(np.median(distances)) / views[0].camera.fx
    position, fall = _falls(cylinder, axis, end, inside, outside, pixel, views, others, basis, view_offset, blur)
    if not len(position) or fall.max() < 0.0:
        return None
    along = np.arange(-inside, outside, pixel / SAMPLES_PER_PIXEL, dtype=float)
    slopes = [_slopes(axis, end, cylinder.radius, along, view) for view in views]
    edges = np.concatenate(slopes) if slopes else np.zeros((0, len(along)))
    seen = np.isfinite(edges)
    if not seen.any():
        return None
    typical = float(np.median(np.abs(edges[seen])))
    strength = np.where(seen, np.abs(edges) / (np.abs(edges) + 2.0 * typical + 1e-9), 0.0)
    count = seen.sum(axis=0)
    vote = strength.sum(axis=0) / (count + SECTORS)
    score = np.interp(along, position, fall, left=-1.0, right=-1.0) + vote
    score -= FAR_PENALTY * (along / outside) ** 2 + OUTER_PENALTY * np.maximum(along, 0.0) / outside
    best = int(np.argmax(score))
    if np.interp(along[best], position, fall) < 0.0:
        return None
    return _refined(strength, seen, along, best, pixel)


def _falls(
    cylinder: Cylinder,
    axis: FloatArray,
    end: FloatArray,
    inside: float,
    outside: float,
    pixel: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    view_offset: FloatArray,
    blur: float,
) -> tuple[FloatArray, FloatArray]:
    """Positions along `axis` from `end` and how much the support of the outlines falls there, -1 where too little."""
    stretch = Cylinder(end - inside * axis, end + outside * axis, cylinder.radius)
    at, edges = outline_edges(stretch, views, others, basis, view_offset, 1.5, blur, 6)
    if not len(at):
        return np.zeros(0), np.zeros(0)
    profile = support_profile(at, hits(at, edges, view_offset))
    position = profile.along + 0.5 * (outside - inside)
    seen, found = profile.seen.sum(axis=1), profile.hits.sum(axis=1)
    window = max(cylinder.radius, 30.0 * pixel)
    fall = np.full(len(position), -1.0)
    for index, here in enumerate(position):
        before = (position > here - window) & (position <= here)
        after = (position > here) & (position <= here + window)
        if seen[before].sum() >= MIN_SEEN and seen[after].sum() >= MIN_SEEN:
            inner, outer = (found[part].sum() / seen[part].sum() for part in (before, after))
            if inner - outer >= min(MIN_FALL, MIN_SHARE * (inner + CHANCE)):
                fall[index] = inner - outer
    # The rim decides within the coarse step of the stations.
    return position, maximum_filter1d(fall, 3)


def _slopes(axis: FloatArray, end: FloatArray, radius: float, along: FloatArray, view: View) -> FloatArray:
    """Derivative of the light along the axis (SECTORS, T) on the unrolled barrel; NaN outside the image."""
    towards = camera_centre(view) - end
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
    inside = sharp.reshape(SECTORS, RAYS_PER_SECTOR, -1).all(axis=1)
    if not inside.any():
        return np.full(inside.shape, np.nan)
    low = np.maximum(np.floor(pixel[sharp].min(axis=0)).astype(int) - 2, 0)
    high = np.ceil(pixel[sharp].max(axis=0)).astype(int) + 3
    light = cv2.LUT(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]), LINEAR_LIGHT)
    where = (pixel - low).astype(np.float32).reshape(len(angle), len(along), 2)
    light = cv2.remap(light, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mean = light.reshape(SECTORS, RAYS_PER_SECTOR, -1).mean(axis=1, dtype=float)
    return np.where(inside, gaussian_filter1d(mean, SAMPLES_PER_PIXEL, axis=1, order=1), np.nan)


def _refined(strength: FloatArray, seen: FloatArray, along: FloatArray, best: int, pixel: float) -> End:
    """The peak near sample `best` of each view, their median and its deviation."""
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
        return End(float(along[best]), 2.0 * pixel)
    position = float(np.median(places))
    scatter = 1.4826 * float(np.median(np.abs(np.array(places) - position)))
    return End(position, float(np.hypot(1.25 * scatter / np.sqrt(len(places)), 0.5 * pixel)))
