# SPDX-License-Identifier: Apache-2.0
"""Pipes seen from inside: a camera in a sewer sees a concave cylinder around it, among stray points.

Such clouds have gaps and strong noise, so that local curvature and growth along the axis, by which pipes are found from
outside, fail. Here each pair of surface normals that intersect proposes an axis and a radius; random search around the
best proposals maximises the part of the circumference that agrees with the cylinder.
"""

from __future__ import annotations

from typing import NamedTuple

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

# Sites at which the surface is estimated need 50 points in the cloud, and 10 good sites make a search. Their patches
# are half of the least radius wide, on which that pipe is flat to h^2 / (8 r), a thirty-second of its radius, but 20 mm
# at least, which averages the noise, and 80 mm at most; sites stand a quarter of it apart, so that patches overlap.
_LEAST_POINTS, _LEAST_SITES = 50, 10
_PATCH_RADII, _LEAST_PATCH, _MOST_PATCH = 0.5, 0.02, 0.08
_SITES_PER_PATCH = 0.25
# A patch tells a normal where it is less than 0.4 times as thick as it is wide, as standard deviations.
_FLAT = 0.4
# Of all pairs of sites a hundredth lie on one pipe even where nine tenths of the sites are stray: of 40000 pairs 400.
# Not more than 4000 sites are searched, which bounds the time.
_PAIRS = 40_000
_MOST_SITES = 4_000
# Normals at less than 25 deg to each other do not tell where they meet. Those of one circle meet at equal distances, to
# 15 % of their mean, and their sites lie within two diameters of the thickest pipe.
_LEAST_ANGLE = float(np.sin(np.radians(25.0)))
_UNEQUAL = 0.15
_FARTHEST_PAIR = 4.0
# Sites agree with a cylinder within 3 sigma (99.7 % of Gaussian noise) and 3 % of the radius, which a start is off by,
# where their normal is within 32 deg of the direction to the axis: the patches' normals are that rough in torn clouds.
_SIGMAS, _SHARE = 3.0, 0.03
_LEAST_COSINE = 0.85
# Sectors of 10 deg of the circumference, in each of which the agreeing sites count together.
_SECTORS = 36
# Half of the stretch of a pipe on which sites are counted, in radii: normals tell the axis over a diameter or two.
_REACH = 2.0
# Every second site is counted for the first judgement of all hypotheses; those of less than a fifth of the best one's
# value are left out.
_THINNED = 2
_LEAST_VALUE = 0.2
# The 48 best hypotheses are refined by 400 random steps each, which shrink from a tenth of the radius to a hundredth,
# as the tolerance does from the start's to the noise's; every 40 steps the value is taken again, since the tolerance
# has changed by a tenth of its way. The 12 best of them are measured.
_STARTS, _STEPS = 48, 400
_FIRST_STEP, _LAST_STEP = 0.1, 0.01
_SAME_TOLERANCE = 40
_BEST = 12
# A pipe is moved to where it is seen best over three times its own length either way.
_SHIFT_LENGTHS = 3.0
# Hypotheses whose radii, and whose axes where they lie, differ by less than a tenth of the radius, and whose directions
# differ by less than 10 deg, are one: the refinement moves them by as much.
_ALIKE = 0.1
_ALIKE_COSINE = float(np.cos(np.radians(10.0)))
# Points within 1.5 radii of the axis are fitted: the start is off by a tenth of the radius, the wall's far scatter by
# more. The fit is repeated, 8 times at most, until the radius changes by less than half of its standard deviation.
_FITTED_RADII = 1.5
_MOST_TURNS = 8
_SETTLED = 0.5
# Scatter of points about the surface [m]: the noise, 1.2 times as large as estimated on patches that follow it, and 0.5
# mm of waviness. Depth cameras are twice as rough at the far end of a pipe as on average.
_UNDERESTIMATED, _WAVINESS = 1.2, 5e-4
_ROUGHNESS = 2.0
# Halves of the stretches on which a pipe that was found is followed, in radii. A longer one is taken where the radius
# stays within 2 standard deviations, and at least half of what was added is seen.
_STRETCHES = (3.0, 4.5, 6.5, 10.0)
_SAME_RADIUS = 2.0
_LEAST_ADDED = 0.5
# Most points behind the wall of a pipe, as a share of the points on it: from inside none is seen, stray ones are some.
# Points within 3 bands of the surface are on the wall, from 4 bands on behind it; they are compared in cells of 10 deg
# and half a radius along the axis.
_INTRUSION_MAX = 0.15
_WALL_BANDS, _BEHIND_BANDS = 3.0, 4.0
_CELLS_PER_RADIUS = 2.0
# A pipe that was found goes on as far as the camera sees, too rough there to be measured: points up to 10 radii or 1 m
# beyond its ends, within 1.3 radii and 6 bands of its axis, are taken out of the search.
_TAKEN_RADII, _TAKEN_LENGTH = 10.0, 1.0
_TAKEN_REACH, _TAKEN_BANDS = 1.3, 6.0


class _Sites(NamedTuple):
    """Sites on surfaces: points (S, 3) [m], unit normals (S, 3) of either sign, and weights (S,)."""

    points: FloatArray
    normals: FloatArray
    weight: FloatArray


def find_concave(
    tree: Octree,
    around: SceneContext,
    criteria: AcceptanceCriteria,
    radius_range: tuple[float, float],
    seed: int,
) -> list[Candidate]:
    """Candidates for pipes that are seen from inside among the tree's points, the one with most points first.

    Where `around` knows the normals of the surface, they must point to the axis. Radii are sought in
    `radius_range` [m]. Pairs of sites and steps are drawn at random by `seed`.
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
        margin = max(_TAKEN_RADII * cylinder.radius, _TAKEN_LENGTH) * cylinder.axis
        reach = _TAKEN_REACH * cylinder.radius + _TAKEN_BANDS * best.band
        free[tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)] = False


def _measured(tree: Octree, start: Cylinder, stretch: float, criteria: AcceptanceCriteria) -> Candidate | None:
    """The candidate fitted around `start`, `stretch` radii to either side; None where it is not accepted."""
    middle = start.middle
    cylinder = start
    most = wide = _ROUGHNESS * (_UNDERESTIMATED * criteria.noise + _WAVINESS)
    # The band selects the points of the fit, and the residuals of the fit give the band.
    for _ in range(_MOST_TURNS):
        half = stretch * cylinder.radius * cylinder.axis
        cylinder = Cylinder(middle - half, middle + half, cylinder.radius)
        points = tree.points[tree.near_segment(cylinder.start, cylinder.end, _FITTED_RADII * cylinder.radius)]
        settled = refit(points, cylinder, wide, whole=True)
        if settled is None:
            return None
        candidate = settled
        change = abs(candidate.cylinder.radius - cylinder.radius)
        cylinder, wide = candidate.cylinder, min(candidate.band, most)
        if change < _SETTLED * candidate.radius_sigma:
            break
    if not criteria.accept(candidate) or _beyond(points, candidate) > _INTRUSION_MAX * candidate.points:
        return None
    return candidate


def _grown(tree: Octree, pipe: Candidate, criteria: AcceptanceCriteria) -> Candidate:
    """The pipe on the longest of the stretches along which its radius stays the same and its surface is seen."""
    for stretch in _STRETCHES:
        more = _measured(tree, pipe.cylinder, stretch, criteria)
        if more is None or abs(more.cylinder.radius - pipe.cylinder.radius) > _SAME_RADIUS * pipe.radius_sigma:
            break
        # Across a gap the far end may show the whole circle again; it is not joined.
        if _seen(more) - _seen(pipe) < _LEAST_ADDED * (more.cylinder.length - pipe.cylinder.length):
            break
        pipe = more
    return pipe


def _seen(candidate: Candidate) -> float:
    """Length [m] of the barrel on which points cover it."""
    return candidate.evidence.coverage * candidate.cylinder.length


def _beyond(points: FloatArray, candidate: Candidate) -> int:
    """Number of points (of N, 3) behind the wall where the wall is seen; from inside, a wall hides them.

    In each cell of the surface at most as many count as the wall has there.
    """
    cylinder = candidate.cylinder
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    along, x, y = offset @ cylinder.axis, offset @ u, offset @ v
    slices = int(np.ceil(_CELLS_PER_RADIUS * cylinder.length / cylinder.radius))
    here = (along > 0) & (along < cylinder.length)
    distance = np.hypot(x, y) - cylinder.radius
    sector = ((np.arctan2(y, x) + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
    cell = sector + _SECTORS * np.floor(along / cylinder.length * slices).astype(int)
    wall = np.bincount(cell[here & (np.abs(distance) < _WALL_BANDS * candidate.band)], minlength=_SECTORS * slices)
    behind = np.bincount(cell[here & (distance > _BEHIND_BANDS * candidate.band)], minlength=_SECTORS * slices)
    return int(np.minimum(wall, behind).sum())


def _sites(tree: Octree, sigma: float, least_radius: float) -> _Sites | None:
    """Sites where the cloud is a surface, at most 4000; None where there are too few.

    The weight of a site is the number of points in its patch: near the camera clouds are dense and precise. Weights
    capped at the 1024 points that a normal is fitted to are no better: with seeds 0 and 1 they name 16 and 17 of 34
    real sewer clouds, those here 18 and 18.
    """
    if len(tree.points) < _LEAST_POINTS:
        return None
    scale = float(np.clip(_PATCH_RADII * least_radius, _LEAST_PATCH, _MOST_PATCH))
    shape = local_shape.surfaces(tree, tree.thinned(tree.level_of(_SITES_PER_PATCH * scale)), scale, sigma)
    good = np.flatnonzero((shape.count > 0) & (shape.spread[:, 0] < _FLAT * shape.spread[:, 1]))
    good = good[:: -(-len(good) // _MOST_SITES)] if len(good) else good
    if len(good) < _LEAST_SITES:
        return None
    return _Sites(shape.feet[good], shape.normals[good], shape.count[good].astype(float))


def _starts(tree: Octree, sigma: float, radius_range: tuple[float, float], seed: int) -> list[Cylinder]:
    """Different cylinders through two sites each, refined, the one that most of its circumference agrees with first."""
    sites = _sites(tree, sigma, radius_range[0])
    if sites is None:
        return []
    rng = np.random.default_rng(seed)
    share = np.cumsum(sites.weight) / sites.weight.sum()
    pairs = np.minimum(np.searchsorted(share, rng.random((_PAIRS, 2))), len(share) - 1)
    centres, axes, radii = _through_pairs(sites, pairs, radius_range)
    if not len(radii):
        return []
    some = _Sites(*(each[::_THINNED] for each in sites))
    agreement = _agreements(some, centres, axes, radii, _SIGMAS * sigma)
    found: list[tuple[float, Cylinder]] = []
    waiting = agreement > _LEAST_VALUE * agreement.max()
    for number in np.argsort(-agreement, kind="stable"):
        if len(found) == _STARTS or not waiting[number]:
            continue
        waiting &= ~_alike(centres, axes, radii, int(number))
        steps = rng.normal(size=(_STEPS, 7))
        value, centre, axis, radius = _refined(
            sites, centres[number], axes[number], radii[number], sigma, steps, radius_range
        )
        found.append((value, _seen_best(sites, Cylinder(centre, centre + _REACH * radius * axis, radius), sigma)))
    found.sort(key=lambda each: -each[0])
    different: list[Cylinder] = []
    for _, cylinder in found:
        if len(different) < _BEST and not any(_same(cylinder, other) for other in different):
            different.append(cylinder)
    return different


def _same(one: Cylinder, other: Cylinder) -> bool:
    """Whether two cylinders are one within what measuring them corrects."""
    centres = np.stack([each.middle for each in (other, one)])
    axes, radii = np.stack([other.axis, one.axis]), np.array([other.radius, one.radius])
    return bool(_alike(centres, axes, radii, 0)[1])


def _alike(centres: FloatArray, axes: FloatArray, radii: FloatArray, number: int) -> NDArray[np.bool_]:
    """Which cylinders (H,) are the one with this number within what the refinement corrects."""
    offset = centres - centres[number]
    lateral = np.linalg.norm(offset - (offset @ axes[number])[:, None] * axes[number], axis=1)
    allowed = _ALIKE * radii[number]
    same = np.abs(axes @ axes[number]) > _ALIKE_COSINE
    return np.asarray(same & (lateral < allowed) & (np.abs(radii - radii[number]) < allowed))


def _through_pairs(
    sites: _Sites, pairs: NDArray[np.int64], radius_range: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on the axes (H, 3), directions (H, 3) and radii (H,) of the cylinders that pairs (P, 2) make."""
    points, across = sites.points, sites.normals
    one, other = pairs[:, 0], pairs[:, 1]
    axis = np.cross(across[one], across[other])
    sine = np.linalg.norm(axis, axis=1)
    gap = points[other] - points[one]
    near = (sine > _LEAST_ANGLE) & (np.linalg.norm(gap, axis=1) < _FARTHEST_PAIR * radius_range[1])
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


def _seen_best(sites: _Sites, cylinder: Cylinder, sigma: float) -> Cylinder:
    """The cylinder moved along its axis to where the sites on its surface, over its own length, have most weight."""
    along, distance = cylinder.along(sites.points), cylinder.surface_distance(sites.points)
    near = np.abs(distance) < _SIGMAS * sigma + _SHARE * cylinder.radius
    near &= np.abs(along) < _SHIFT_LENGTHS * cylinder.length
    if not near.any():
        return cylinder
    order = np.flatnonzero(near)[np.argsort(along[near], kind="stable")]
    place, total = along[order], np.append(0.0, np.cumsum(sites.weight[order]))
    within = total[np.searchsorted(place, place + cylinder.length)] - total[:-1]
    start = cylinder.start + place[int(np.argmax(within))] * cylinder.axis
    return Cylinder(start, start + cylinder.length * cylinder.axis, cylinder.radius)


@njit(cache=True)
def _agreement(sites: _Sites, centre: FloatArray, axis: FloatArray, radius: float, tolerance: float) -> float:
    """How well sites agree with a cylinder by distance, up to `tolerance` [m], and normal, over its circumference.

    A site adds its weight times 1 - (distance / tolerance)^2 (MSAC) to its sector. The square roots of the sectors'
    sums are added up, so that an arc, which tells the radius, counts for more than a dense patch.
    """
    u, v = basis(axis)
    sectors = np.zeros(_SECTORS)
    points, normals = sites.points, sites.normals
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
        nx = normals[i, 0] * u[0] + normals[i, 1] * u[1] + normals[i, 2] * u[2]
        ny = normals[i, 0] * v[0] + normals[i, 1] * v[1] + normals[i, 2] * v[2]
        if abs(x * nx + y * ny) > _LEAST_COSINE * rho:
            sector = int((np.arctan2(y, x) + np.pi) * (_SECTORS / (2.0 * np.pi))) % _SECTORS
            sectors[sector] += sites.weight[i] * (1.0 - miss * miss)
    return float(np.sqrt(sectors).sum())


@njit(cache=True)
def _agreements(sites: _Sites, centres: FloatArray, axes: FloatArray, radii: FloatArray, slack: float) -> FloatArray:
    """The agreement (H,) of sites with each of many cylinders, within `slack` [m] and a share of the radius."""
    out = np.zeros(len(radii))
    for h in range(len(radii)):
        out[h] = _agreement(sites, centres[h], axes[h], radii[h], slack + _SHARE * radii[h])
    return out


@njit(cache=True)
def _refined(
    sites: _Sites,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    sigma: float,
    steps: FloatArray,
    radius_range: tuple[float, float],
) -> tuple[float, FloatArray, FloatArray, float]:
    """Agreement, point on the axis, direction and radius of the best cylinder near the given one, by random search.

    Of the steps (S, 7), which shrink like the tolerance, each that improves the agreement is taken: three numbers turn
    the axis, three move it, one scales the radius.
    """
    narrow = _SIGMAS * sigma
    wide = narrow + _SHARE * radius
    best = 0.0
    for turn in range(len(steps)):
        done = turn / len(steps)
        tolerance = wide * (narrow / wide) ** done
        size = _FIRST_STEP * (_LAST_STEP / _FIRST_STEP) ** done
        if turn % _SAME_TOLERANCE == 0:
            best = _agreement(sites, centre, axis, radius, tolerance)
        step = steps[turn]
        turned = axis + size * step[:3]
        turned /= np.sqrt(turned @ turned)
        moved = centre + size * radius * step[3:6]
        other = radius * np.exp(size * step[6])
        if other < radius_range[0] or other > radius_range[1]:
            continue
        value = _agreement(sites, moved, turned, other, tolerance)
        if value > best:
            best, centre, axis, radius = value, moved, turned, other
    return _agreement(sites, centre, axis, radius, narrow), centre, axis, radius
