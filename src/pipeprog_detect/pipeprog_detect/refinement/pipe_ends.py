# SPDX-License-Identifier: Apache-2.0
"""The ends of a pipe in the keyframes: the end rim, seen on the unrolled barrel, where the contour stops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.axial_evidence import AxialEvidence, axial_evidence
from pipeprog_detect.silhouette.apparent_contour import ViewArrays
from pipeprog_detect.silhouette.edge_support import NEAR
from pipeprog_detect.silhouette.occlusion import cylinder_rows
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.silhouette.surface_light import light_on
from pipeprog_detect.types import Cylinder, View

# The part of the barrel that faces the camera steeply enough to resolve lengths on it: half of its arc [rad], the
# sectors that it is divided into, and the lines along the axis in each.
HALF_ARC, SECTORS, RAYS_PER_SECTOR = np.radians(70.0), 6, 4
# Samples for one pixel along the axis.
SAMPLES_PER_PIXEL = 2
# The end is sought this far beyond the given one [m, radii], and as far inside, at most this share of the length.
OUTSIDE, OUTSIDE_RADII, MOST_INSIDE = 0.15, 3.0, 0.6
# Positions less probable by the contour than the best one by more than this are left out (natural logarithm: one in
# three thousand), and an edge all around the barrel is worth at most three times as much: the contour tells the
# position to some samples, the rim within them.
PLAUSIBLE, RIM_WORTH = 8.0, 25.0
# Edges all around a barrel in a metre of it that are no end: a clamp, a weld or a coupling has two. To a pixel, one is
# no more probable at an end than such an edge is by chance.
OTHER_RIMS = 2.0
# Pixels beside what hides the barrel that are left out: its edge is none of the barrel's.
BESIDE_HIDDEN = 4
# Width of a rim's own edge [px].
BESIDE_RIM = 4
# Evidence (natural logarithm) of a hidden position: without a rim beyond it the pipe ends before it.
UNSEEN = -1.0
# Of two rims the inner one ends the barrel (an elbow or a collar has further rims outside): what the outermost position
# costs of an edge's strength, 0 to 1.
OUTER_PENALTY = 0.3
# Views that tell a rim without those that look into the end: a shadow beside it moves from one to the next.
LEAST_OUTSIDE = 3
# Scale [m] of the Cauchy distribution of the barrel's end about that of the cloud's surface, which may be torn.
SURFACE_SIGMA = 0.01
# Radius of the bend of an elbow, in radii of the pipe (a long one, EN 10253: 1.5 diameters), and the share of ends at
# an elbow: as many as not.
BEND, AT_ELBOW = 3.0, 0.5
# The cloud's surface goes on over the end by half a stereo window [m], and into a bend as far as that stays within the
# surface's thickness [m].
FATTENED, THICKNESS = 0.02, 0.006


@dataclass(frozen=True)
class End:
    """Where a pipe ends: `position` outwards from the given end and its standard deviation [m].

    `odds`: logarithm of how much more probable the edges there are on an end rim than beside one.
    """

    position: float
    sigma: float
    odds: float


def find_ends(scene: Scene, surface: Cylinder | None) -> tuple[End | None, End | None]:
    """What the images tell of the cylinder's start and end; None where they tell nothing.

    `surface`: a cylinder on its axis, between whose ends the cloud shows the pipe, or None.
    """
    if surface is None:
        return find_end(scene, False, None), find_end(scene, True, None)
    whole = scene.cylinder
    before, after = float((surface.start - whole.start) @ whole.axis), float((whole.end - surface.end) @ whole.axis)
    return find_end(scene, False, -max(before, 0.0)), find_end(scene, True, -max(after, 0.0))


def find_end(scene: Scene, at_end: bool, surface_end: float | None) -> End | None:
    """The end of the straight barrel near the given one, or None where the images do not tell.

    The end is where the evidence of the contour for the pipe is complete and where, on the barrel unrolled from each
    view by the known axis and radius, an edge lies across the axis at one position for all directions and views. The
    circle of the rim needs no conic that way: its projection is the unrolling itself. `surface_end` [m], outwards from
    the given end, is where the surface seen in the cloud ends, if it shows the pipe.
    """
    cylinder = scene.cylinder
    outside = max(OUTSIDE, OUTSIDE_RADII * cylinder.radius)
    inside = min(outside, MOST_INSIDE * cylinder.length)
    if surface_end is not None:
        inside = min(inside, FATTENED + into_bend(cylinder.radius, THICKNESS) - surface_end)
    evidence = axial_evidence(scene, at_end, outside)
    if evidence is None:
        return None
    position, odds = _odds(evidence, inside)
    if not len(odds) or int(np.argmax(odds)) == len(odds) - 1:
        return None
    barrel = cylinder if at_end else Cylinder(cylinder.end, cylinder.start, cylinder.radius)
    pixel = pixel_at(barrel.end, scene.views)
    along = np.arange(-inside, outside, pixel / SAMPLES_PER_PIXEL, dtype=float)
    axis = barrel.end + along[::SAMPLES_PER_PIXEL, None] * barrel.axis
    looking = np.flatnonzero(ViewArrays.of(scene.views).showing(axis))
    if not len(looking):
        return None
    strength, seen = rim_strength(barrel, along, [scene.views[index] for index in looking], scene.others)
    if not seen.any():
        return None
    rim = all_around(strength, seen) - OUTER_PENALTY * np.maximum(along, 0.0) / outside
    if surface_end is not None:
        odds = odds - np.log1p(((position - surface_end) / SURFACE_SIGMA) ** 2)
    likely = before_bend(np.interp(along, position, odds) - float(odds.max()), along, evidence, cylinder.radius, pixel)
    best = int(np.argmax(np.where(likely > -PLAUSIBLE, likely + RIM_WORTH * rim, -np.inf)))
    return End(*_refined(strength, seen, along, best, pixel), min(RIM_WORTH * _contrast(rim, best), by_chance(pixel)))


def by_chance(pixel: float) -> float:
    """Log odds of an edge all around being an end's, seen to a `pixel` [m], where nothing else tells of the end."""
    return -float(np.log(OTHER_RIMS * pixel))


def into_bend(radius: float, aside: float) -> float:
    """How far [m] an elbow on a pipe of `radius` [m] goes on along its axis before it is `aside` [m] of it."""
    return float(np.sqrt(2.0 * BEND * radius * aside))


def before_bend(
    odds: FloatArray, position: FloatArray, evidence: AxialEvidence, radius: float, pixel: float
) -> FloatArray:
    """Log odds (T,) that the barrel ends at even positions (T,) [m], whether an elbow follows or not.

    An elbow's contour leaves the barrel's by less than edges are told apart for some way: what is seen to end there may
    be the elbow's. Where something hides the end nothing is seen to end.

    Args:
        odds: (T,) that the contour ends there.
        position: (T,) outwards [m].
        evidence: of the contour.
        radius: of the pipe [m].
        pixel: one at the end [m].
    """
    next_sample = np.minimum(np.searchsorted(evidence.along, position), len(evidence.along) - 1)
    in_sight = np.where(evidence.seen[next_sample] > 0, odds, -np.inf)
    ahead = int(into_bend(radius, NEAR * pixel) / float(position[1] - position[0]))
    later = maximum_filter1d(in_sight, ahead + 1, mode="nearest", origin=-((ahead + 1) // 2))
    return np.asarray(np.maximum(odds, later + np.log(AT_ELBOW)), np.float64)


def pixel_at(point: FloatArray, views: Sequence[View]) -> float:
    """Length [m] at a point (3,) that is one pixel in the median view."""
    return float(np.median([np.linalg.norm(point - view.centre) for view in views])) / views[0].camera.fx


def rim_strength(
    barrel: Cylinder, along: FloatArray, views: Sequence[View], others: Sequence[Cylinder]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Strength (V * SECTORS, T), 0 to 1, of edges across the axis at `along` (T,) [m] beyond the end, and where seen.

    An edge as strong as twice the median one has half. V: the views that the end is sought in (`_outside_views`).
    """
    edges = np.concatenate(_outside_views(barrel, along, views, cylinder_rows(others)))
    seen = np.isfinite(edges)
    typical = float(np.median(np.abs(edges[seen]))) if seen.any() else 0.0
    return np.where(seen, np.abs(edges) / (np.abs(edges) + 2.0 * typical + 1e-9), 0.0), seen


def _outside_views(barrel: Cylinder, along: FloatArray, views: Sequence[View], others: FloatArray) -> list[FloatArray]:
    """The slopes (SECTORS, T) of the views that do not look into the end; of all where too few such show the barrel.

    Who looks at the face of an end sees its rim twice: the near half, between barrel and face, which may be alike, and
    the far half, before the background, up to a diameter farther along the barrel.
    """
    into = np.array([(view.centre - barrel.end) @ barrel.axis > 0.0 for view in views])
    outside = [_slopes(barrel, along, views[index], others) for index in np.flatnonzero(~into)]
    if sum(bool(np.isfinite(edges).any()) for edges in outside) >= LEAST_OUTSIDE:
        return outside
    return outside + [_slopes(barrel, along, views[index], others) for index in np.flatnonzero(into)]


def _contrast(rim: FloatArray, best: int) -> float:
    """By how much the strength (T,) at sample `best` exceeds all others: beside an equal one nothing tells the end."""
    elsewhere = np.abs(np.arange(len(rim)) - best) > BESIDE_RIM * SAMPLES_PER_PIXEL
    return max(float(rim[best]) - max(float(rim[elsewhere].max(initial=0.0)), 0.0), 0.0)


def all_around(strength: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """By how much the edges (V * SECTORS, T) of all sectors exceed the median position's, at each position (T,).

    Texture has edges in some sectors: the weaker half counts of those that are seen. Where no more than half of all are
    seen it is 0.
    """
    count = seen.reshape(-1, SECTORS, seen.shape[1]).sum(axis=0)
    mean = np.where(count > 0, strength.reshape(-1, SECTORS, seen.shape[1]).sum(axis=0) / (count + 1.0), np.inf)
    sectors = (count > 0).sum(axis=0)
    shown = sectors > SECTORS // 2
    if not shown.any():
        return np.zeros(len(shown))
    half = np.maximum(sectors // 2, 1)
    total = np.cumsum(np.sort(mean, axis=0), axis=0)
    weaker = total[half - 1, np.arange(len(half))] / half
    return np.where(shown, weaker - np.median(weaker[shown]), 0.0)


def _odds(evidence: AxialEvidence, inside: float) -> tuple[FloatArray, FloatArray]:
    """Positions (M,) beyond `-inside` [m] and the log odds, up to a constant, that the pipe ends there."""
    step = float(evidence.along[1] - evidence.along[0])
    position = np.append(evidence.along - 0.5 * step, evidence.along[-1] + 0.5 * step)
    total = np.append(0.0, np.cumsum(np.where(evidence.seen > 0, evidence.log_odds, UNSEEN)))
    searched = position > -inside
    return position[searched], total[searched]


def _slopes(barrel: Cylinder, along: FloatArray, view: View, others: FloatArray) -> FloatArray:
    """Derivative (SECTORS, T) of the light along the axis at `along` (T,) [m] beyond the end; NaN where unseen."""
    axis, end = barrel.axis, barrel.end
    towards = view.centre - end
    towards = towards - axis * (axis @ towards)
    towards = towards / np.linalg.norm(towards)
    unseen = np.full((SECTORS, len(along)), np.nan)
    angle = np.linspace(-HALF_ARC, HALF_ARC, SECTORS * RAYS_PER_SECTOR)
    radial = np.cos(angle)[:, None] * towards + np.sin(angle)[:, None] * np.cross(axis, towards)
    points = end + along[None, :, None] * axis + barrel.radius * radial[:, None]
    light, sharp = light_on(points.reshape(-1, 3), view, others)
    inside = sharp.reshape(SECTORS, RAYS_PER_SECTOR, -1).all(axis=1)
    inside = minimum_filter1d(inside, 2 * BESIDE_HIDDEN * SAMPLES_PER_PIXEL + 1, axis=1)
    if not inside.any():
        return unseen
    mean = light.reshape(SECTORS, RAYS_PER_SECTOR, -1).mean(axis=1)
    return np.where(inside, gaussian_filter1d(mean, SAMPLES_PER_PIXEL, axis=1, order=1), np.nan)


def _refined(
    strength: FloatArray, seen: NDArray[np.bool_], along: FloatArray, best: int, pixel: float
) -> tuple[float, float]:
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
