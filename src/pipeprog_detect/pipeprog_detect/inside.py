"""Pipes seen from inside: a camera in a sewer sees a concave cylinder around it, among stray points.

Near and half-dark, such clouds are too torn for curvature; two normals that meet give an axis and a radius at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_detect import normals
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.fit import fit_cylinder
from pipeprog_detect.hypotheses import Hypothesis
from pipeprog_detect.octree import Octree
from pipeprog_detect.pipe import Cylinder, FloatArray
from pipeprog_detect.surroundings import Surroundings
from pipeprog_detect.verify import Candidate, measure

# Of all pairs of sites a hundredth lie on one pipe even where nine tenths of the sites are stray: 200 good ones remain.
_PAIRS = 20_000
_MOST_SITES = 4_000
_BEST = 12
# Hypotheses whose radii, and whose axes where they lie, differ by less than this share of the radius are one.
_ALIKE = 0.1
# Normals at less than 25 deg to each other do not tell where they meet; those of one circle meet at equal distances.
_LEAST_ANGLE = float(np.sin(np.radians(25.0)))
_UNEQUAL = 0.15
# A smaller arc is as well a bent piece of something else.
_LEAST_ARC = np.radians(75.0)
# Neither within the pipe nor beyond its wall is there much to see from inside.
_STRAY = 0.15
# Depth cameras are several times as rough at the far end of a pipe as at the near one.
_ROUGHNESS = 2.0
# The camera is a few radii away from what it sees best, and a depth camera's noise a hundredth of that at most.
_ROUGHEST = 0.05


def find_concave(
    tree: Octree,
    around: Surroundings,
    sigma: float,
    radius_range: tuple[float, float],
    config: DetectConfig,
) -> list[Candidate]:
    """Cylinders of the tree's points that are seen from inside, the best supported first.

    Where the normals `around` are known they must point to the axis; sigma [m] is the noise.
    """
    free = np.ones(len(tree.points), bool)
    found: list[Candidate] = []
    while True:
        measured = [
            measure(tree, free, each, sigma) for each in _hypotheses(tree.subset(free), sigma, radius_range, config)
        ]
        good = [each for each in measured if each is not None and is_concave_pipe(each, sigma, config)]
        good = [each for each in good if _beyond(tree, each) < _STRAY * each.points]
        good = [each for each in good if (around.outwardness(each) or -1.0) < 0.0]
        if not good:
            return found
        best = max(good, key=lambda candidate: candidate.points)
        found.append(best)
        cylinder = best.cylinder
        # The pipe goes on as far as the camera sees, too rough there to be measured.
        margin = max(10.0 * cylinder.radius, 1.0) * cylinder.axis
        reach = 1.3 * cylinder.radius + 6.0 * best.band
        free[tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)] = False


def is_concave_pipe(candidate: Candidate, sigma: float, config: DetectConfig) -> bool:
    """Whether the evidence makes a pipe of a cylinder that is seen from inside."""
    evidence, cylinder = candidate.evidence, candidate.cylinder
    return (
        cylinder.length >= max(0.5 * cylinder.radius, config.length_min)
        and candidate.radius_sigma < 0.02 * cylinder.radius
        and evidence.arc >= max(_LEAST_ARC, np.radians(config.arc_min_deg))
        and evidence.coverage > 0.4
        and evidence.inside < _STRAY
        and evidence.noise < min(_ROUGHNESS * (1.6 * sigma + 8e-4), _ROUGHEST * cylinder.radius)
        and evidence.roundness < _ROUGHNESS * (0.3 * sigma + 0.02 * cylinder.radius + 3e-4)
    )


def _beyond(tree: Octree, candidate: Candidate) -> int:
    """How many points lie behind the wall of a pipe that is seen from inside, up to half its radius."""
    cylinder = candidate.cylinder
    within = len(tree.near_segment(cylinder.start, cylinder.end, cylinder.radius + 4.0 * candidate.band))
    return len(tree.near_segment(cylinder.start, cylinder.end, 1.5 * cylinder.radius)) - within


def _hypotheses(
    tree: Octree, sigma: float, radius_range: tuple[float, float], config: DetectConfig
) -> list[Hypothesis]:
    """Cylinders through two sites each, the few that most sites agree with, refined on all of them."""
    if len(tree.points) < 50:
        return []
    # Patches on which the thinnest pipe looked for is still flat to a few sigma, and that hold its noise down.
    scale = float(np.clip(0.5 * radius_range[0], 0.02, 0.08))
    sites = tree.thinned(tree.level_of(0.25 * scale))
    shape = normals.surfaces(tree, sites, scale, sigma)
    good = np.flatnonzero((shape.count > 0) & (shape.spread[:, 0] < 0.4 * shape.spread[:, 1]))
    good = good[:: -(-len(good) // _MOST_SITES)] if len(good) else good
    if len(good) < 10:
        return []
    points, across = shape.feet[good], shape.normals[good]
    pairs = np.random.default_rng(config.seed).integers(0, len(good), (_PAIRS, 2))
    centres, axes, radii = _through_pairs(points, across, pairs, radius_range)
    if not len(radii):
        return []
    # Near the camera the cloud is dense and fine, far from it neither: what is dense tells more.
    weight = np.sqrt(shape.count[good])
    worth = _worth(points, across, weight, centres, axes, radii, 3.0 * sigma)
    found: list[Hypothesis] = []
    waiting = worth > 0.2 * worth.max()
    for number in np.argsort(-worth, kind="stable"):
        if len(found) == _BEST or not waiting[number]:
            continue
        waiting &= ~_alike(centres, axes, radii, int(number))
        reach = 2.0 * radii[number] * axes[number]
        start = Cylinder(centres[number] - reach, centres[number] + reach, float(radii[number]))
        fit = fit_cylinder(points, across, start, 1.5 * sigma + 5e-4, along_ray=False)
        if fit is not None and radius_range[0] < fit.cylinder.radius < radius_range[1]:
            found.append(
                Hypothesis(
                    _densest(points[fit.inliers], shape.count[good][fit.inliers], fit.cylinder), int(fit.inliers.sum())
                )
            )
    return found


def _alike(centres: FloatArray, axes: FloatArray, radii: FloatArray, number: int) -> NDArray[np.bool_]:
    """Which cylinders (H,) are the one with this number within what the refinement mends."""
    offset = centres - centres[number]
    lateral = np.linalg.norm(offset - (offset @ axes[number])[:, None] * axes[number], axis=1)
    allowed = _ALIKE * radii[number]
    same = np.abs(axes @ axes[number]) > np.cos(np.radians(10.0))
    return np.asarray(same & (lateral < allowed) & (np.abs(radii - radii[number]) < allowed))


def _densest(points: FloatArray, count: NDArray[np.int64], cylinder: Cylinder) -> Cylinder:
    """The stretch of a diameter's length, at least 30 cm, around whose sites the cloud has most points.

    From there, where it is dense and fine, the pipe is followed.
    """
    along = (points - cylinder.start) @ cylinder.axis
    order = np.argsort(along, kind="stable")
    along = along[order]
    total = np.append(0, np.cumsum(count[order]))
    span = max(2.0 * cylinder.radius, 0.3)
    within = total[np.searchsorted(along, along + span)] - total[:-1]
    start = cylinder.start + along[int(np.argmax(within))] * cylinder.axis
    return Cylinder(start, start + span * cylinder.axis, cylinder.radius)


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


@njit(cache=True)
def _worth(
    points: FloatArray,
    across: FloatArray,
    weight: FloatArray,
    centres: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    slack: float,
) -> FloatArray:
    """Weight of the sites that agree with each cylinder, up to three radii along it: by distance (MSAC) and normal."""
    out = np.zeros(len(radii))
    for h in range(len(radii)):
        tolerance = slack + 0.03 * radii[h]
        for i in range(len(points)):
            ox, oy, oz = points[i, 0] - centres[h, 0], points[i, 1] - centres[h, 1], points[i, 2] - centres[h, 2]
            z = ox * axes[h, 0] + oy * axes[h, 1] + oz * axes[h, 2]
            if abs(z) > 3.0 * radii[h]:
                continue
            x, y, w = ox - z * axes[h, 0], oy - z * axes[h, 1], oz - z * axes[h, 2]
            rho = np.sqrt(x * x + y * y + w * w) + 1e-12
            miss = (rho - radii[h]) / tolerance
            if abs(miss) < 1.0 and abs(x * across[i, 0] + y * across[i, 1] + w * across[i, 2]) > 0.85 * rho:
                out[h] += weight[i] * (1.0 - miss * miss)
    return out
