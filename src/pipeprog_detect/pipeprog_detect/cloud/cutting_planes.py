# SPDX-License-Identifier: Apache-2.0
"""The front end of the paper (Algorithm 3): pipes are sought as ellipses where a plane cuts them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.cloud import local_shape
from pipeprog_detect.cloud.axis_voting import Hypothesis, line_votes, patch_votes
from pipeprog_detect.cloud.cylinder_fit import basis, quick_fit
from pipeprog_detect.cloud.ellipse_search import Ellipse, find_ellipses
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.types import Cylinder

# Three points span a plane where their parallelogram has more than 1 mm^2 [m^2]; below, rounding turns its normal.
_COLLINEAR = 1e-6
# Points within 10 mm of the plane are its section: three times the noise of a cloud of 3 mm.
SLAB = 0.01
# Thin pipes have too few points in it: where the smear of a slant is straightened, points within 30 mm count.
_THICK_SLAB = 0.03
# Points of a slab are thinned to cells of 2 mm, below the noise of a cloud of photographs: that bounds the time a plane
# takes by its area.
_CELL = 2e-3
# Sizes [m] of the patches whose directions tell where planes are placed: 40 mm show the bend of radii from 40 to 80 mm
# and the lines of radii up to 20 mm, 80 mm the bend of radii up to 160 mm and the lines of radii up to 40 mm. They hold
# cells of a seventh of their size, up to 150 points: more do not make the normal better.
_PATCHES = (0.04, 0.08)
_CELLS_PER_SCALE = 7.0
# Directions are alike within 10 deg: local directions scatter by 2 to 5 deg about their pipe's, two differ by twice
# that.
_ALIKE = float(np.radians(10.0))
# A family is dense where 3 % of all directions are alike: of directions all around 1.5 % would be (the cap of 10 deg is
# 1 - cos(10 deg) of a hemisphere). In small clouds four: two agree by chance, four seldom.
_LEAST_SHARE, _LEAST_DIRECTIONS = 0.03, 4
# Planes stand 0.3 m apart, so that the shortest pipe that is common on a site is cut once, between the quantiles of 1 %
# and 99 % of the places of the family: what is farther out is stray.
_SPACING = 0.3
_END_SHARE = 0.01
# Triples of points for a circle: one is clean at 99 % where six tenths of the points are stray (1 - (1 - 0.4^3)^70).
_TRIPLES = 70
# Points around an axis among which its circle is sought: up to gamma_R = max(2 R, R + 0.1 m) off it (the paper), and R
# along it, 3 cm at least; an even subset of 4000 bounds the time.
_REACH, _LEAST_REACH = 2.0, 0.1
_LEAST_HALF = 0.03
_MOST_POINTS = 4000
# Of these, points up to 1.5 R and 3 sigma from the axis belong to the circle or are stray, farther ones to neighbours;
# 30 of them are ten a parameter.
_NEAR, _NEAR_SIGMAS = 1.5, 3.0
_LEAST_POINTS = 30
# Points agree with a circle within 2.5 sigma (98.8 % of Gaussian noise) and a tenth of the radius: over a radius of the
# axis either side its tilt of up to 10 deg moves them by 0.17 R at most.
_BAND_SIGMAS, _BAND_SHARE = 2.5, 0.1
# Circles through three points count where their radius is 0.6 to 1.6 times the ellipse's: two steps of 25 % between
# standard sizes either way; beyond, the circle is another pipe's.
_THINNER, _THICKER = 0.6, 1.6
# Gauss-Newton steps to a circle: from one through three of its points a few suffice, 8 are a bound. It needs 10 points,
# three a parameter. 1e-9 on the diagonal of the normal matrix, whose entries are sums over those points of up to 1
# each, keeps it solvable.
_CIRCLE_STEPS = 8
_LEAST_AGREEING = 10
_RIDGE = 1e-9
# A proposed cylinder reaches two radii either side of its plane, 5 cm at least: its candidate is followed from there.
_HALF_LENGTH, _LEAST_HALF_LENGTH = 2.0, 0.05


@dataclass(frozen=True)
class CuttingPlane:
    """A plane by a point (3,) on it [m] and its unit normal (3,)."""

    point: FloatArray
    normal: FloatArray


def parse_planes(text: str) -> list[CuttingPlane]:
    """Planes from the setting: three points each, `x,y,z x,y,z x,y,z`, planes parted by semicolons.

    Raises InputError for anything else and for points on one line.
    """
    planes = []
    for part in text.split(";"):
        try:
            points = np.array([[float(number) for number in word.split(",")] for word in part.split()])
        except ValueError:
            points = np.zeros(0)
        if points.shape != (3, 3) or not np.isfinite(points).all():
            raise InputError(f"plane '{part.strip()}': give three points as x,y,z x,y,z x,y,z in metres")
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        size = float(np.linalg.norm(normal))
        if size < _COLLINEAR:
            raise InputError(f"plane '{part.strip()}': its three points lie on one line: move one of them aside")
        planes.append(CuttingPlane(points.mean(axis=0), normal / size))
    return planes


def place_planes(tree: Octree, sigma: float, radius_range: tuple[float, float]) -> list[CuttingPlane]:
    """Planes across the directions that pipes run in, the commonest direction first, at even distances over its pipes.

    The directions come from bent patches and from lines of points of the tree, whose noise is `sigma` [m].
    """
    places, directions = [], []
    for scale in _PATCHES:
        sites = tree.thinned(tree.level_of(scale))
        shape = local_shape.surfaces(tree.thinned(tree.level_of(scale / _CELLS_PER_SCALE)), sites, scale, sigma)
        for votes in (patch_votes(shape, sigma, radius_range), line_votes(shape, sigma, 0.5 * scale)):
            places.append(votes.feet)
            directions.append(votes.directions)
    place, direction = np.concatenate(places), np.concatenate(directions)
    planes: list[CuttingPlane] = []
    for family in direction_families(direction):
        axis = np.linalg.eigh(direction[family].T @ direction[family])[1][:, 2]
        along = place[family] @ axis
        low, high = np.quantile(along, [_END_SHARE, 1.0 - _END_SHARE])
        count = max(int(np.ceil((high - low) / _SPACING)), 1)
        planes += [CuttingPlane(t * axis, axis) for t in low + (np.arange(count) + 0.5) * (high - low) / count]
    return planes


def direction_families(directions: FloatArray) -> list[IntArray]:
    """Rows of the unit directions (N, 3) that are alike regardless of sign, the largest family first.

    Density clustering (DBSCAN) by the angle between axes; stray directions are in no family.
    """
    from sklearn.cluster import DBSCAN  # half a second that only this front end needs

    least = max(int(np.ceil(_LEAST_SHARE * len(directions))), _LEAST_DIRECTIONS)
    if len(directions) < least:
        return []
    # The elements of d d^T do not know the sign of d; those of two axes at an angle are sqrt(2) sin(angle) apart.
    products = (directions[:, :, None] * directions[:, None, :]).reshape(-1, 9)
    label = DBSCAN(eps=float(np.sqrt(2.0) * np.sin(_ALIKE)), min_samples=least).fit(products).labels_
    families = [np.flatnonzero(label == family) for family in range(int(label.max()) + 1)]
    return sorted(families, key=len, reverse=True)


def section_hypotheses(
    tree: Octree,
    free: NDArray[np.bool_],
    planes: Sequence[CuttingPlane],
    sigma: float,
    radius_range: tuple[float, float],
    seed: int,
    straighten: bool,
) -> Iterator[Hypothesis]:
    """A cylinder for each ellipse in which a plane cuts the points of the tree that are free at that time (N,).

    Eq. 3 of the paper: the minor semi-axis is the radius, and the axis is the plane's normal turned by
    +- acos(minor / major) about the minor axis; the one whose points make the better circle is taken. A slab is as
    thick as a thin pipe is wide, so that a slanting one smears its section into another ellipse: where `straighten`,
    cylinders fitted to the points of the slab where they are compete, too, and what is left is sought in a thicker one.
    """
    rng = np.random.default_rng(seed)
    for plane in planes:
        u, v = basis(plane.normal)
        height = np.abs((tree.points - plane.point) @ plane.normal)
        for slab in (SLAB, _THICK_SLAB) if straighten else (SLAB,):
            rows = np.flatnonzero(free & (height < slab))
            offset = tree.points[rows] - plane.point
            flat = np.stack([offset @ u, offset @ v], axis=1)
            _, first = np.unique(np.floor(flat / _CELL).astype(np.int64), axis=0, return_index=True)
            for ellipse in find_ellipses(flat[np.sort(first)], sigma, radius_range, rng):
                turned = _turned(ellipse, plane)
                if straighten:
                    near = np.linalg.norm(flat - ellipse.centre, axis=1) < ellipse.major + _NEAR_SIGMAS * sigma + slab
                    turned += _straightened(tree.points[rows[near]], turned, sigma)
                judged = [each for each in (_circle(tree, free, section, sigma, rng) for section in turned) if each]
                if judged:
                    best = min(judged, key=lambda each: each[0])[1]
                    if radius_range[0] < best.radius < radius_range[1]:
                        yield Hypothesis(best, len(ellipse.inliers))


def _turned(ellipse: Ellipse, plane: CuttingPlane) -> list[Cylinder]:
    """The two cylinders, as long as the slab is thick, that the plane cuts in the ellipse (Eq. 3)."""
    u, v = basis(plane.normal)
    centre = plane.point + ellipse.centre[0] * u + ellipse.centre[1] * v
    along = np.cos(ellipse.angle) * u + np.sin(ellipse.angle) * v
    delta = np.arccos(min(ellipse.minor / ellipse.major, 1.0))
    found = []
    for sign in (-1.0, 1.0):
        axis = np.cos(delta) * plane.normal + sign * np.sin(delta) * along
        found.append(Cylinder(centre - SLAB * axis, centre + SLAB * axis, ellipse.minor))
    return found


def _straightened(points: FloatArray, turned: Sequence[Cylinder], sigma: float) -> list[Cylinder]:
    """The cylinders again, each fitted to the points (N, 3) of the slab as what they are: a short piece of a pipe."""
    fits = [quick_fit(points, start, sigma, 4.0) for start in turned]
    return [fit[0] for fit in fits if fit is not None]


def _circle(
    tree: Octree,
    free: NDArray[np.bool_],
    section: Cylinder,
    sigma: float,
    rng: np.random.Generator,
) -> tuple[float, Cylinder] | None:
    """Root mean square [m] about the circle that the points around an axis make seen along it, and its cylinder.

    Points count within gamma_R of the axis, and a radius along it: farther off the error of the axis, up to 10 deg,
    smears them. None where there are too few points or no circle.
    """
    axis, radius = section.axis, section.radius
    centre = section.middle
    reach = max(_REACH * radius, radius + _LEAST_REACH)
    length = max(radius, _LEAST_HALF) * axis
    rows = tree.near_segment(centre - length, centre + length, reach)
    rows = rows[free[rows]]
    rows = rows[:: -(-len(rows) // _MOST_POINTS)] if len(rows) else rows
    u, v = basis(axis)
    offset = tree.points[rows] - centre
    seen = np.stack([offset @ u, offset @ v], axis=1)
    near = np.linalg.norm(seen, axis=1) < _NEAR * radius + _NEAR_SIGMAS * sigma
    if near.sum() < _LEAST_POINTS:
        return None
    points = np.ascontiguousarray(seen[near])
    band = _BAND_SIGMAS * sigma + _BAND_SHARE * radius
    x, y, fitted, rms = _robust_circle(points, rng.integers(0, len(points), (_TRIPLES, 3)), radius, band)
    if not fitted > 0.0:
        return None
    middle = centre + x * u + y * v
    half = max(_HALF_LENGTH * fitted, _LEAST_HALF_LENGTH) * axis
    return rms, Cylinder(middle - half, middle + half, fitted)


@njit(cache=True)
def _robust_circle(
    points: FloatArray, triples: NDArray[np.int64], radius: float, band: float
) -> tuple[float, float, float, float]:
    """Centre, radius and root mean square [m] of the circle that most points agree with; radius 0 where none does."""
    bx, by, br, least = 0.0, 0.0, 0.0, np.inf
    for k in range(len(triples)):
        one, two, three = points[triples[k, 0]], points[triples[k, 1]], points[triples[k, 2]]
        ax, ay, cx, cy = two[0] - one[0], two[1] - one[1], three[0] - one[0], three[1] - one[1]
        area = 2.0 * (ax * cy - ay * cx)
        if abs(area) < 1e-12:
            continue
        aa, cc = ax * ax + ay * ay, cx * cx + cy * cy
        x, y = (cy * aa - ay * cc) / area, (ax * cc - cx * aa) / area
        r = np.sqrt(x * x + y * y)
        if not _THINNER * radius < r < _THICKER * radius:
            continue
        x, y = x + one[0], y + one[1]
        cost = 0.0
        for i in range(len(points)):
            d = (np.sqrt((points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2) - r) / band
            cost += min(d * d, 1.0)
        if cost < least:
            bx, by, br, least = x, y, r, cost
    square = 0.0
    for _ in range(_CIRCLE_STEPS):
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        square, total = 0.0, 0
        for i in range(len(points)):
            x, y = points[i, 0] - bx, points[i, 1] - by
            rho = np.sqrt(x * x + y * y) + 1e-12
            d = rho - br
            square += min(d * d, band * band)
            if abs(d) >= band or br == 0.0:
                continue
            total += 1
            row = np.array([-x / rho, -y / rho, -1.0])
            for a in range(3):
                right[a] -= row[a] * d
                for b in range(3):
                    matrix[a, b] += row[a] * row[b]
        if total < _LEAST_AGREEING:
            return 0.0, 0.0, 0.0, np.inf
        for a in range(3):
            matrix[a, a] += _RIDGE
        step = np.linalg.solve(matrix, right)
        bx, by, br = bx + step[0], by + step[1], br + step[2]
    return bx, by, br, np.sqrt(square / len(points))
