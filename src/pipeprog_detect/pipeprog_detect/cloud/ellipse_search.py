# SPDX-License-Identifier: Apache-2.0
"""Ellipses among the points of a section: connected components, each searched for ellipses that do not overlap.

The distance to an ellipse is the one along the confocal hyperbola through the point, which meets the ellipse at a
right angle (Rosin 1996; Maalek and Lichti's confocal hyperbola): exact on the axes, within a hundredth elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray, IntArray

# Five-point samples: log 0.01 / log(1 - 1/32), so that one of them has no stray point at 99 % where half are stray.
_SAMPLES = 146
# Of the ellipses sampled, these cost least and are refined, twice each: the first refinement starts beside the minimum.
_BEST = 5
_CONCENTRATIONS = 2
# Points of an ellipse: five times its parameters. Part of it that they cover: less leaves the axes undetermined.
_LEAST_POINTS = 25
_LEAST_ARC = np.radians(90.0)
# Minor over major semi-axis: a plane that meets an axis at less than 9 deg does not cut the pipe across.
_LEAST_ASPECT = 0.15
# Points within the inlier band, as a share of those within twice the band: of evenly stray points half are.
_LEAST_SHARE = 0.6
# Share of an ellipse's interior within an earlier one: pipes do not overlap, their measured sections may by the noise.
_MOST_OVERLAP = 0.2
# Points within this multiple of the noise belong to an ellipse: 99 % of its own do.
_INLIER = 2.5


@dataclass(frozen=True)
class Ellipse:
    """Centre (2,), semi-axes [m] and the direction [rad] of the major one; inliers: rows of the points on it."""

    centre: FloatArray
    major: float
    minor: float
    angle: float
    inliers: IntArray


def components(points: FloatArray, least: int = _LEAST_POINTS) -> list[IntArray]:
    """Rows of the connected components of points (N, 2), the largest first, those under `least` points left out.

    Points are neighbours within eight times the median distance to the next one, 5 mm at least, 30 mm at most: along
    a line of random points every thousandth gap is seven times as wide as the mean one.
    """
    if len(points) < least:
        return []
    from sklearn.cluster import DBSCAN  # half a second that only this front end needs

    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    reach = float(np.clip(8.0 * np.median(nearest), 5e-3, 30e-3))
    label = DBSCAN(eps=reach, min_samples=1).fit(points).labels_  # with one sample density is connectedness
    order = np.argsort(label, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(label))[:-1])
    return sorted((part for part in parts if len(part) >= least), key=len, reverse=True)


def find_ellipses(
    points: FloatArray, sigma: float, radius_range: tuple[float, float], rng: np.random.Generator
) -> list[Ellipse]:
    """Ellipses among points (N, 2) of known noise `sigma` [m] whose minor semi-axes are in the range [m].

    In each component a Monte-Carlo search takes the ellipse through five points that most points agree with, refines
    it on them, removes them, and goes on while what it finds holds; later ellipses do not overlap earlier ones.
    """
    found: list[Ellipse] = []
    for part in components(points):
        rest: IntArray = part
        while len(rest) >= _LEAST_POINTS:
            ellipse = _best_ellipse(points[rest], sigma, radius_range, rng)
            if ellipse is None:
                break
            ellipse = Ellipse(ellipse.centre, ellipse.major, ellipse.minor, ellipse.angle, rest[ellipse.inliers])
            if not any(_overlap(ellipse, earlier) > _MOST_OVERLAP for earlier in found):
                found.append(ellipse)
            rest = np.setdiff1d(rest, ellipse.inliers)
    return found


def _best_ellipse(
    points: FloatArray, sigma: float, radius_range: tuple[float, float], rng: np.random.Generator
) -> Ellipse | None:
    samples = _samples(points, radius_range, rng)
    candidates = np.concatenate([_through_five(samples, radius_range), _through_three(samples, radius_range)])
    if not len(candidates):
        return None
    points = np.ascontiguousarray(points)
    cost = _costs(points, candidates, _INLIER * sigma)
    best, least = None, np.inf
    for number in np.argsort(cost, kind="stable")[:_BEST]:
        ellipse = candidates[number]
        for _ in range(_CONCENTRATIONS):
            ellipse = _refine(points, ellipse, sigma)
        if not radius_range[0] < ellipse[3] < radius_range[1] or ellipse[3] < _LEAST_ASPECT * ellipse[2]:
            continue
        refined = _costs(points, ellipse[None], _INLIER * sigma)[0]
        if refined < least:
            best, least = ellipse, refined
    if best is None:
        return None
    distance = np.abs(_distances(points, best))
    inliers = np.flatnonzero(distance < _INLIER * sigma)
    around = int((distance < 2.0 * _INLIER * sigma).sum())
    if len(inliers) < max(_LEAST_POINTS, _LEAST_SHARE * around) or _arc(points[inliers], best) < _LEAST_ARC:
        return None
    return Ellipse(best[:2].copy(), float(best[2]), float(best[3]), float(best[4]), inliers)


def _samples(points: FloatArray, radius_range: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Sets (S, 5, 2) of five points each, all within a few radii of one."""
    tree = cKDTree(points)
    seeds = rng.integers(0, len(points), _SAMPLES)
    low, high = np.log(radius_range)
    reach = 2.5 * np.exp(rng.uniform(low, high, _SAMPLES))
    sets = []
    for seed, near in zip(seeds, tree.query_ball_point(points[seeds], reach, return_sorted=True), strict=True):
        if len(near) > 5:
            sets.append(np.append(rng.choice(near, 4, replace=False), seed))
    return points[np.array(sets)] if sets else np.zeros((0, 5, 2))


def _through_three(chosen: FloatArray, radius_range: tuple[float, float]) -> FloatArray:
    """Circles (C, 5), as ellipses, through the first three points of each set.

    Noise makes hyperbolas of most conics through five near points; a circle that is stretched while it is refined
    starts nearer.
    """
    one, two, three = chosen[:, 0], chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0]
    area = 2.0 * (two[:, 0] * three[:, 1] - two[:, 1] * three[:, 0])
    bent = np.abs(area) > 1e-12
    one, two, three, area = one[bent], two[bent], three[bent], area[bent]
    first, second = (two**2).sum(axis=1), (three**2).sum(axis=1)
    x = (three[:, 1] * first - two[:, 1] * second) / area
    y = (two[:, 0] * second - three[:, 0] * first) / area
    radius = np.hypot(x, y)
    circles = np.stack([one[:, 0] + x, one[:, 1] + y, radius, radius, np.zeros_like(radius)], axis=1)
    return circles[(radius > radius_range[0]) & (radius < radius_range[1])]


def _through_five(chosen: FloatArray, radius_range: tuple[float, float]) -> FloatArray:
    """Ellipses (E, 5) through the five points of each set, of minor semi-axes in the range."""
    centre = chosen.mean(axis=1, keepdims=True)
    size = np.abs(chosen - centre).max(axis=(1, 2), keepdims=True) + 1e-12
    x, y = np.moveaxis((chosen - centre) / size, 2, 0)
    rows = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=2)
    a, b, c, d, e, f = np.linalg.svd(rows)[2][:, -1].T
    determinant = 4.0 * a * c - b * b
    real = determinant > 1e-9
    a, b, c, d, e, f, determinant = (value[real] for value in (a, b, c, d, e, f, determinant))
    xc, yc = (b * e - 2.0 * c * d) / determinant, (b * d - 2.0 * a * e) / determinant
    level = -(f + 0.5 * (d * xc + e * yc))
    forms = np.stack([np.stack([a, 0.5 * b], axis=1), np.stack([0.5 * b, c], axis=1)], axis=1) / level[:, None, None]
    forms = np.where(np.isfinite(forms), forms, 0.0)
    values, vectors = np.linalg.eigh(forms)
    size, centre = size[real][:, 0, 0], centre[real][:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        major, minor = size / np.sqrt(values[:, 0]), size / np.sqrt(values[:, 1])
    ellipses = np.stack(
        [
            centre[:, 0] + size * xc,
            centre[:, 1] + size * yc,
            major,
            minor,
            np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]),
        ],
        axis=1,
    )
    good = np.isfinite(ellipses).all(axis=1) & (minor > radius_range[0]) & (minor < radius_range[1])
    return np.ascontiguousarray(ellipses[good & (minor > _LEAST_ASPECT * major)])


def _overlap(later: Ellipse, earlier: Ellipse) -> float:
    """Share of the interior of one ellipse that lies within another."""
    radius, angle = np.meshgrid(np.sqrt((np.arange(6) + 0.5) / 6), np.arange(24) * (np.pi / 12))
    x, y = later.major * radius.ravel() * np.cos(angle.ravel()), later.minor * radius.ravel() * np.sin(angle.ravel())
    cosine, sine = np.cos(later.angle), np.sin(later.angle)
    points = later.centre + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)
    parameters = np.array([*earlier.centre, earlier.major, earlier.minor, earlier.angle])
    return float((_distances(points, parameters) < 0.0).mean())


def _arc(points: FloatArray, ellipse: FloatArray) -> float:
    """Part of the ellipse [rad, of its eccentric angle] that has points, in sectors of 10 deg."""
    offset = points - ellipse[:2]
    cosine, sine = np.cos(ellipse[4]), np.sin(ellipse[4])
    x, y = offset @ [cosine, sine] / ellipse[2], offset @ [-sine, cosine] / ellipse[3]
    sector = ((np.arctan2(y, x) + np.pi) * (18 / np.pi)).astype(int) % 36
    return float(len(np.unique(sector)) * np.pi / 18)


@njit(cache=True)
def _distance(px: float, py: float, e: FloatArray, cosine: float, sine: float) -> float:
    x = (px - e[0]) * cosine + (py - e[1]) * sine
    y = (py - e[1]) * cosine - (px - e[0]) * sine
    major, minor = e[2], e[3]
    focal = np.sqrt(max(major * major - minor * minor, 0.0))
    if focal < 1e-6 * major:
        return np.sqrt(x * x + y * y) - major
    far, near = np.sqrt((x + focal) ** 2 + y * y), np.sqrt((x - focal) ** 2 + y * y)
    cos_nu = min(max((far - near) / (2.0 * focal), -1.0), 1.0)
    sin_nu = np.sqrt(1.0 - cos_nu * cos_nu) * (1.0 if y >= 0.0 else -1.0)
    fx, fy = x - major * cos_nu, y - minor * sin_nu
    return np.sqrt(fx * fx + fy * fy) * (1.0 if far + near >= 2.0 * major else -1.0)


@njit(cache=True)
def _distances(points: FloatArray, ellipse: FloatArray) -> FloatArray:
    """Signed distances (N,) [m], positive outside, of points (N, 2) from an ellipse (x, y, major, minor, angle)."""
    cosine, sine = np.cos(ellipse[4]), np.sin(ellipse[4])
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = _distance(points[i, 0], points[i, 1], ellipse, cosine, sine)
    return out


@njit(cache=True)
def _costs(points: FloatArray, ellipses: FloatArray, band: float) -> FloatArray:
    """MSAC cost of each ellipse, per square of the band: a point beyond it costs 1."""
    out = np.zeros(len(ellipses))
    for k in range(len(ellipses)):
        cosine, sine = np.cos(ellipses[k, 4]), np.sin(ellipses[k, 4])
        for i in range(len(points)):
            share = _distance(points[i, 0], points[i, 1], ellipses[k], cosine, sine) / band
            out[k] += min(share * share, 1.0)
    return out


@njit(cache=True)
def _refine(points: FloatArray, start: FloatArray, sigma: float) -> FloatArray:
    """Levenberg-Marquardt over the five parameters with Tukey weights at the known noise."""
    ellipse = start.copy()
    damping = 1e-3
    cut = 4.0 * sigma
    last = np.inf
    step: FloatArray = np.empty(5)
    for _ in range(15):
        steps = np.array([1e-6, 1e-6, 1e-6, 1e-6, 1e-6 / ellipse[2]])
        matrix, right, cost = np.zeros((5, 5)), np.zeros(5), 0.0
        cosine, sine = np.cos(ellipse[4]), np.sin(ellipse[4])
        moved = np.empty((5, 5))
        for k in range(5):
            moved[k] = ellipse
            moved[k, k] += steps[k]
        row = np.empty(5)
        turned_cosine, turned_sine = np.cos(moved[4, 4]), np.sin(moved[4, 4])
        for i in range(len(points)):
            d = _distance(points[i, 0], points[i, 1], ellipse, cosine, sine)
            share = d / cut
            if abs(share) >= 1.0:
                cost += cut * cut / 3.0
                continue
            keep = 1.0 - share * share
            cost += cut * cut / 3.0 * (1.0 - keep**3)
            for k in range(5):
                c, s = (cosine, sine) if k < 4 else (turned_cosine, turned_sine)
                row[k] = (_distance(points[i, 0], points[i, 1], moved[k], c, s) - d) / steps[k]
            for a in range(5):
                right[a] -= keep * keep * row[a] * d
                for b in range(5):
                    matrix[a, b] += keep * keep * row[a] * row[b]
        if cost > last:
            ellipse = ellipse - step
            damping *= 10.0
            if damping > 1e3:
                break
        else:
            if last - cost < 1e-4 * last:
                break
            last = cost
            damping = max(0.2 * damping, 1e-6)
            held_matrix, held_right = matrix, right
        solvable = held_matrix.copy()
        for a in range(5):
            solvable[a, a] += damping * held_matrix[a, a] + 1e-12
        step[:] = np.linalg.solve(solvable, held_right)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + step[3] ** 2)
        if size > 0.5 * ellipse[3]:
            step *= 0.5 * ellipse[3] / size
        ellipse = ellipse + step
        if ellipse[2] <= 0.0 or ellipse[3] <= 0.0:
            return start
    if ellipse[3] > ellipse[2]:
        return np.array([ellipse[0], ellipse[1], ellipse[3], ellipse[2], ellipse[4] + 0.5 * np.pi])
    return ellipse
