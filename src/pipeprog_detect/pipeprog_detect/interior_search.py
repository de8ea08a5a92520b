# SPDX-License-Identifier: Apache-2.0
"""Pipes seen from inside: a camera in a sewer sees a concave cylinder around it, among stray points.

Near and half-dark, such clouds are too torn for curvature and for following a pipe along its axis: two normals that
meet give an axis and a radius at once, a search around them the cylinder that most of the circumference agrees with.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import local_shape
from pipeprog_detect.cloud.acceptance import AcceptanceCriteria
from pipeprog_detect.cloud.candidate import Candidate, refit
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.scene_context import SceneContext

# Of all pairs of sites a hundredth lie on one pipe even where nine tenths of the sites are stray: 400 good ones remain.
_PAIRS = 40_000
_MOST_SITES = 4_000
# The 48 best hypotheses are sharpened by 400 random steps each, which shrink from a tenth of the radius to a hundredth;
# the 12 best of them are measured.
_STARTS, _STEPS = 48, 400
_FIRST_STEP, _LAST_STEP = 0.1, 0.01
_BEST = 12
# Part of the circumference on which agreeing sites count together.
_SECTORS = 36
# Half of a stretch that is sharpened on, in radii: normals tell the axis over a diameter or two.
_REACH = 2.0
# Halves of the stretches on which a pipe that was found is followed, in radii.
_STRETCHES = (3.0, 4.5, 6.5, 10.0)
_MOST_TURNS = 8
# Hypotheses whose radii, and whose axes where they lie, differ by less than this share of the radius are one.
_ALIKE = 0.1
# Normals at less than 25 deg to each other do not tell where they meet; those of one circle meet at equal distances.
_LEAST_ANGLE = float(np.sin(np.radians(25.0)))
_UNEQUAL = 0.15
# Most points within the pipe or behind its wall, in points on the wall: from inside neither is seen.
_INTRUSION_MAX = 0.15
# Depth cameras are several times as rough at the far end of a pipe as at the near one.
_ROUGHNESS = 2.0


def find_concave(
    tree: Octree,
    around: SceneContext,
    criteria: AcceptanceCriteria,
    radius_range: tuple[float, float],
    seed: int,
) -> list[Candidate]:
    """Cylinders of the tree's points that are seen from inside, the best supported first.

    Where the normals `around` are known they must point to the axis. The search takes random pairs of sites and random
    steps, both by `seed`.
    """
    free = np.ones(len(tree.points), bool)
    found: list[Candidate] = []
    while True:
        rest = tree.subset(free)
        starts = _starts(rest, criteria.noise, radius_range, seed)
        measured = [_measured(rest, start, _REACH, criteria) for start in starts]
        good = [each for each in measured if each is not None and (around.outwardness(each) or -1.0) < 0.0]
        if not good:
            return found
        best = _grown(rest, max(good, key=lambda candidate: candidate.points), criteria)
        found.append(best)
        cylinder = best.cylinder
        # The pipe goes on as far as the camera sees, too rough there to be measured.
        margin = max(10.0 * cylinder.radius, 1.0) * cylinder.axis
        reach = 1.3 * cylinder.radius + 6.0 * best.band
        free[tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)] = False


def _measured(tree: Octree, start: Cylinder, stretch: float, criteria: AcceptanceCriteria) -> Candidate | None:
    """The pipe that a nearly right cylinder is, as far as `stretch` radii either side; None where it is none."""
    middle = start.middle
    cylinder = start
    most = wide = _ROUGHNESS * (1.2 * criteria.noise + 5e-4)
    # The band decides which points are fitted, and the fit what the band holds.
    for _ in range(_MOST_TURNS):
        half = stretch * cylinder.radius * cylinder.axis
        cylinder = Cylinder(middle - half, middle + half, cylinder.radius)
        points = tree.points[tree.near_segment(cylinder.start, cylinder.end, 1.5 * cylinder.radius)]
        settled = refit(points, cylinder, wide, whole=True)
        if settled is None:
            return None
        candidate = settled
        change = abs(candidate.cylinder.radius - cylinder.radius)
        cylinder, wide = candidate.cylinder, min(candidate.band, most)
        if change < 0.5 * candidate.radius_sigma:
            break
    if not criteria.accept(candidate) or _beyond(points, candidate) > _INTRUSION_MAX * candidate.points:
        return None
    return candidate


def _grown(tree: Octree, pipe: Candidate, criteria: AcceptanceCriteria) -> Candidate:
    """The pipe as far as its surface can be followed: farther on it is rougher, what draws the radius is left out."""
    for stretch in _STRETCHES:
        more = _measured(tree, pipe.cylinder, stretch, criteria)
        if more is None or abs(more.cylinder.radius - pipe.cylinder.radius) > 2.0 * pipe.radius_sigma:
            break
        # The far end closes the circle once more, a gap away.
        if _seen(more) - _seen(pipe) < 0.5 * (more.cylinder.length - pipe.cylinder.length):
            break
        pipe = more
    return pipe


def _seen(candidate: Candidate) -> float:
    return candidate.evidence.coverage * candidate.cylinder.length


def _beyond(points: FloatArray, candidate: Candidate) -> int:
    """How many points lie behind the wall where it is seen: what a wall hides is not seen from inside.

    In each cell of the surface no more of them count than the wall has there.
    """
    cylinder = candidate.cylinder
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    along, x, y = offset @ cylinder.axis, offset @ u, offset @ v
    slices = int(np.ceil(2.0 * cylinder.length / cylinder.radius))
    here = (along > 0) & (along < cylinder.length)
    distance = np.hypot(x, y) - cylinder.radius
    sector = ((np.arctan2(y, x) + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
    cell = sector + _SECTORS * np.floor(along / cylinder.length * slices).astype(int)
    wall = np.bincount(cell[here & (np.abs(distance) < 3.0 * candidate.band)], minlength=_SECTORS * slices)
    behind = np.bincount(cell[here & (distance > 4.0 * candidate.band)], minlength=_SECTORS * slices)
    return int(np.minimum(wall, behind).sum())


def _starts(tree: Octree, sigma: float, radius_range: tuple[float, float], seed: int) -> list[Cylinder]:
    """Cylinders through two sites each that most of their circumference agrees with, sharpened, the best first."""
    if len(tree.points) < 50:
        return []
    # Patches on which the thinnest pipe looked for is still flat to a few sigma, and that hold its noise down.
    scale = float(np.clip(0.5 * radius_range[0], 0.02, 0.08))
    sites = tree.thinned(tree.level_of(0.25 * scale))
    shape = local_shape.surfaces(tree, sites, scale, sigma)
    good = np.flatnonzero((shape.count > 0) & (shape.spread[:, 0] < 0.4 * shape.spread[:, 1]))
    good = good[:: -(-len(good) // _MOST_SITES)] if len(good) else good
    if len(good) < 10:
        return []
    points, across = shape.feet[good], shape.normals[good]
    # Near the camera the cloud is dense and fine, far from it neither: what is dense tells more.
    weight = shape.count[good].astype(float)
    rng = np.random.default_rng(seed)
    share = np.cumsum(weight) / weight.sum()
    pairs = np.minimum(np.searchsorted(share, rng.random((_PAIRS, 2))), len(good) - 1)
    centres, axes, radii = _through_pairs(points, across, pairs, radius_range)
    if not len(radii):
        return []
    some = slice(None, None, 2)
    worth = _worths(points[some], across[some], weight[some], centres, axes, radii, 3.0 * sigma)
    found: list[tuple[float, Cylinder]] = []
    waiting = worth > 0.2 * worth.max()
    for number in np.argsort(-worth, kind="stable"):
        if len(found) == _STARTS or not waiting[number]:
            continue
        waiting &= ~_alike(centres, axes, radii, int(number))
        steps = rng.normal(size=(_STEPS, 7))
        value, centre, axis, radius = _sharpened(
            points, across, weight, centres[number], axes[number], radii[number], sigma, steps, *radius_range
        )
        found.append((value, _densest(points, weight, Cylinder(centre, centre + 2.0 * radius * axis, radius), sigma)))
    found.sort(key=lambda each: -each[0])
    different: list[Cylinder] = []
    for _, cylinder in found:
        if len(different) < _BEST and not any(_same(cylinder, other) for other in different):
            different.append(cylinder)
    return different


def _same(one: Cylinder, other: Cylinder) -> bool:
    """Whether two cylinders are one within what measuring them mends."""
    centres = np.stack([each.middle for each in (other, one)])
    axes, radii = np.stack([other.axis, one.axis]), np.array([other.radius, one.radius])
    return bool(_alike(centres, axes, radii, 0)[1])


def _alike(centres: FloatArray, axes: FloatArray, radii: FloatArray, number: int) -> NDArray[np.bool_]:
    """Which cylinders (H,) are the one with this number within what the refinement mends."""
    offset = centres - centres[number]
    lateral = np.linalg.norm(offset - (offset @ axes[number])[:, None] * axes[number], axis=1)
    allowed = _ALIKE * radii[number]
    same = np.abs(axes @ axes[number]) > np.cos(np.radians(10.0))
    return np.asarray(same & (lateral < allowed) & (np.abs(radii - radii[number]) < allowed))


def _through_pairs(
    points: FloatArray, across: FloatArray, pairs: NDArray[np.int64], radius_range: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on the axes (H, 3), directions (H, 3) and radii (H,) of the cylinders that two normals each make."""
    one, other = pairs[:, 0], pairs[:, 1]
    axis = np.cross(across[one], across[other])
    sine = np.linalg.norm(axis, axis=1)
    gap = points[other] - points[one]
    near = (sine > _LEAST_ANGLE) & (np.linalg.norm(gap, axis=1) < 4.0 * radius_range[1])
    one, other, gap = one[near], other[near], gap[near]
    axis = axis[near] / sine[near][:, None]
    gap -= np.einsum("ij,ij->i", gap, axis)[:, None] * axis
    # Distances s, t along the normals to where they meet in the plane across the axis.
    cosine = np.einsum("ij,ij->i", across[one], across[other])
    first, second = (np.einsum("ij,ij->i", gap, across[k]) for k in (one, other))
    s = (first - cosine * second) / (1.0 - cosine**2)
    t = (cosine * first - second) / (1.0 - cosine**2)
    radius = 0.5 * (np.abs(s) + np.abs(t))
    # Normals have either sign: on one circle both lines meet at a radius, the axis halfway between the two feet.
    good = (np.abs(np.abs(s) - np.abs(t)) < _UNEQUAL * radius) & (radius > radius_range[0]) & (radius < radius_range[1])
    centre = 0.5 * (points[one] + s[:, None] * across[one] + points[other] + t[:, None] * across[other])
    return centre[good], axis[good], radius[good]


def _densest(points: FloatArray, weight: FloatArray, cylinder: Cylinder, sigma: float) -> Cylinder:
    """The cylinder moved along its axis to where its surface, over its own length, has most points: seen best there."""
    along, distance = cylinder.along(points), cylinder.surface_distance(points)
    near = (np.abs(distance) < 3.0 * sigma + 0.03 * cylinder.radius) & (np.abs(along) < 3.0 * cylinder.length)
    if not near.any():
        return cylinder
    order = np.flatnonzero(near)[np.argsort(along[near], kind="stable")]
    place, total = along[order], np.append(0.0, np.cumsum(weight[order]))
    within = total[np.searchsorted(place, place + cylinder.length)] - total[:-1]
    start = cylinder.start + place[int(np.argmax(within))] * cylinder.axis
    return Cylinder(start, start + cylinder.length * cylinder.axis, cylinder.radius)


@njit(cache=True)
def _worth(
    points: FloatArray,
    across: FloatArray,
    weight: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    tolerance: float,
) -> float:
    """How far the sites agree with a cylinder by distance (MSAC) and normal, summed over its circumference.

    Of each sector the square root of its weight counts: an arc tells the radius, a dense patch does not.
    """
    u, v = basis(axis)
    sectors = np.zeros(_SECTORS)
    for i in range(len(points)):
        ox, oy, oz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        z = ox * axis[0] + oy * axis[1] + oz * axis[2]
        if abs(z) > _REACH * radius:
            continue
        x = ox * u[0] + oy * u[1] + oz * u[2]
        y = ox * v[0] + oy * v[1] + oz * v[2]
        rho = np.sqrt(x * x + y * y) + 1e-12
        miss = (rho - radius) / tolerance
        if abs(miss) >= 1.0:
            continue
        nx = across[i, 0] * u[0] + across[i, 1] * u[1] + across[i, 2] * u[2]
        ny = across[i, 0] * v[0] + across[i, 1] * v[1] + across[i, 2] * v[2]
        if abs(x * nx + y * ny) > 0.85 * rho:
            sector = int((np.arctan2(y, x) + np.pi) * (_SECTORS / (2.0 * np.pi))) % _SECTORS
            sectors[sector] += weight[i] * (1.0 - miss * miss)
    return float(np.sqrt(sectors).sum())


@njit(cache=True)
def _worths(
    points: FloatArray,
    across: FloatArray,
    weight: FloatArray,
    centres: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    slack: float,
) -> FloatArray:
    """The worth of each of many cylinders."""
    out = np.zeros(len(radii))
    for h in range(len(radii)):
        out[h] = _worth(points, across, weight, centres[h], axes[h], radii[h], slack + 0.03 * radii[h])
    return out


@njit(cache=True)
def _sharpened(
    points: FloatArray,
    across: FloatArray,
    weight: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    sigma: float,
    steps: FloatArray,
    least: float,
    most: float,
) -> tuple[float, FloatArray, FloatArray, float]:
    """Climb to the best cylinder near the given one by random steps (S, 7) that shrink, as the tolerance does."""
    narrow = 3.0 * sigma
    wide = narrow + 0.03 * radius
    best = 0.0
    for turn in range(len(steps)):
        done = turn / len(steps)
        tolerance = wide * (narrow / wide) ** done
        size = _FIRST_STEP * (_LAST_STEP / _FIRST_STEP) ** done
        if turn % 40 == 0:
            best = _worth(points, across, weight, centre, axis, radius, tolerance)
        step = steps[turn]
        turned = axis + size * step[:3]
        turned /= np.sqrt(turned @ turned)
        moved = centre + size * radius * step[3:6]
        other = radius * np.exp(size * step[6])
        if other < least or other > most:
            continue
        worth = _worth(points, across, weight, moved, turned, other, tolerance)
        if worth > best:
            best, centre, axis, radius = worth, moved, turned, other
    return _worth(points, across, weight, centre, axis, radius, narrow), centre, axis, radius
