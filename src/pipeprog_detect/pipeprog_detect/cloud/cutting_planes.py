# SPDX-License-Identifier: Apache-2.0
"""The front end of the paper (Algorithm 3): pipes are sought as ellipses where a plane cuts them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.cloud import local_shape
from pipeprog_detect.cloud.axis_voting import Hypothesis, line_votes, patch_votes
from pipeprog_detect.cloud.cylinder_fit import basis, fit_cylinder
from pipeprog_detect.cloud.ellipse_search import Ellipse, find_ellipses
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.types import Cylinder

# Points this near to the plane are its section [m].
SLAB = 0.01
# Thin pipes have too few points in it; where what a slant smears is straightened, more may be taken [m].
_THICK_SLAB = 0.03
# Points of a slab are thinned to cells of this size [m], below any cloud's noise, which bounds what one plane costs.
_CELL = 2e-3
# Planes placed automatically stand across the directions that at least this share of the patches have, this far apart
# [m]: the shortest pipe that is common on a site is cut once.
_LEAST_SHARE, _MOST_DIRECTIONS, _SPACING = 0.03, 6, 0.3
_ALIKE = float(np.cos(np.radians(15.0)))
_PATCHES = (0.04, 0.08)
# Triples for a circle: one is clean at 99 % where six tenths of the points are stray.
_TRIPLES = 70


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
        if size < 1e-6:
            raise InputError(f"plane '{part.strip()}': its three points lie on one line: move one of them aside")
        planes.append(CuttingPlane(points.mean(axis=0), normal / size))
    return planes


def place_planes(tree: Octree, sigma: float, radius_range: tuple[float, float]) -> list[CuttingPlane]:
    """Planes across the directions that pipes run in, at even distances over where they are, the commonest first."""
    places, directions = [], []
    for scale in _PATCHES:
        sites = tree.thinned(tree.level_of(scale))
        shape = local_shape.surfaces(tree.thinned(tree.level_of(scale / 7.0)), sites, scale, sigma)
        for votes in (patch_votes(shape, sigma, radius_range), line_votes(shape, sigma, 0.5 * scale)):
            places.append(votes.feet)
            directions.append(votes.directions)
    place, direction = np.concatenate(places), np.concatenate(directions)
    planes: list[CuttingPlane] = []
    least = max(_LEAST_SHARE * len(direction), 4.0)
    for _ in range(_MOST_DIRECTIONS):
        if len(direction) < least:
            break
        some = direction[:: -(-len(direction) // 2000)]
        axis = some[int(np.argmax((np.abs(some @ some.T) > _ALIKE).sum(axis=1)))]
        for _ in range(3):
            alike = np.abs(direction @ axis) > _ALIKE
            axis = np.linalg.eigh(direction[alike].T @ direction[alike])[1][:, 2]
        if alike.sum() < least:
            break
        along = place[alike] @ axis
        low, high = np.quantile(along, [0.01, 0.99])
        count = max(int(np.ceil((high - low) / _SPACING)), 1)
        planes += [CuttingPlane(t * axis, axis) for t in low + (np.arange(count) + 0.5) * (high - low) / count]
        place, direction = place[~alike], direction[~alike]
    return planes


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
                    near = np.linalg.norm(flat - ellipse.centre, axis=1) < ellipse.major + 3.0 * sigma + slab
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
    fits = [fit_cylinder(points, start, sigma, along_ray=False) for start in turned]
    return [fit.cylinder for fit in fits if fit is not None]


def _circle(
    tree: Octree,
    free: NDArray[np.bool_],
    section: Cylinder,
    sigma: float,
    rng: np.random.Generator,
) -> tuple[float, Cylinder] | None:
    """Root mean square [m] about the circle that the points around an axis make seen along it, and its cylinder.

    Points count within gamma_R = max(2 R, R + 10 cm) of the axis, and a radius along it: farther off the error of the
    axis, up to 10 deg, smears them.
    """
    axis, radius = section.axis, section.radius
    centre = section.middle
    reach = max(2.0 * radius, radius + 0.1)
    length = max(radius, 0.03) * axis
    rows = tree.near_segment(centre - length, centre + length, reach)
    rows = rows[free[rows]]
    rows = rows[:: -(-len(rows) // 4000)] if len(rows) else rows
    u, v = basis(axis)
    offset = tree.points[rows] - centre
    seen = np.stack([offset @ u, offset @ v], axis=1)
    near = np.linalg.norm(seen, axis=1) < 1.5 * radius + 3.0 * sigma
    if near.sum() < 30:
        return None
    points = np.ascontiguousarray(seen[near])
    band = 2.5 * sigma + 0.1 * radius
    x, y, fitted, rms = _robust_circle(points, rng.integers(0, len(points), (_TRIPLES, 3)), radius, band)
    if not fitted > 0.0:
        return None
    middle = centre + x * u + y * v
    half = max(2.0 * fitted, 0.05) * axis
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
        if not 0.6 * radius < r < 1.6 * radius:
            continue
        x, y = x + one[0], y + one[1]
        cost = 0.0
        for i in range(len(points)):
            d = (np.sqrt((points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2) - r) / band
            cost += min(d * d, 1.0)
        if cost < least:
            bx, by, br, least = x, y, r, cost
    square = 0.0
    for _ in range(8):
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
        if total < 10:
            return 0.0, 0.0, 0.0, np.inf
        for a in range(3):
            matrix[a, a] += 1e-9
        step = np.linalg.solve(matrix, right)
        bx, by, br = bx + step[0], by + step[1], br + step[2]
    return bx, by, br, np.sqrt(square / len(points))
