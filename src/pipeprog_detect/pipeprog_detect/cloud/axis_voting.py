# SPDX-License-Identifier: Apache-2.0
"""Where pipes may be: sites on curved patches vote for an axis and a radius, votes on one line make a hypothesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.local_shape import Surfaces
from pipeprog_detect.types import Cylinder

# Votes agree on an axis within 15 deg (three times the 2 to 5 deg by which local directions scatter), 0.3 radii across
# it and a ratio of 1.3 of the radii (a curvature counts from four standard deviations on: its radius is known to a
# quarter). Two votes agree by chance, four on one line seldom.
_COSINE = float(np.cos(np.radians(15.0)))
_LATERAL = 0.3
_RATIO = 1.3
_LEAST_VOTES = 4
# A curvature counts from this multiple of its standard deviation on.
_BENT = 4.0
# The other principal curvature, as a share of the first (or twice its standard deviation): an elbow of 1.5 diameters
# has one of 1 / 4 along its outer side and 1 / 2 along its inner one, a sphere of 1.
_STRAIGHT = 0.35
# Residual of a quadric, in the noise and a floor [m] for waviness, and least share of the points that agree with it: a
# cleft between two pipes leaves more, and fewer.
_ROUGH, _ROUGH_FLOOR, _ONE_SURFACE = 2.0, 5e-4, 0.75
# Gap along a line [m] (or four patches) that a clamp or an occluder explains.
_GAP = 0.3
# Length of the mean of the patches' unit directions from the axis: below this they lie all around.
_ONE_SIDED = 0.3


@dataclass(frozen=True)
class Sector:
    """The part of a pipe's circumference within `half` [rad] of the direction `front` (3,) from its axis."""

    front: FloatArray
    half: float


@dataclass(frozen=True)
class Hypothesis:
    """A cylinder that `votes` votes agree on, and the sector that their patches lie in, None where that is unknown."""

    cylinder: Cylinder
    votes: int
    sector: Sector | None = None


@dataclass(frozen=True)
class Votes:
    """Points on axes (V, 3) and on the surface (V, 3), axis directions (V, 3), radii (V,), scale of the patches; [m].

    Lines of points vote without a surface: their feet are the points on the axis.
    """

    points: FloatArray
    feet: FloatArray
    directions: FloatArray
    radii: FloatArray
    scale: float


def patch_votes(shape: Surfaces, sigma: float, radius_range: tuple[float, float]) -> Votes:
    """Votes of the sites whose patch is bent one way only, clearly above the noise, by a radius in the range [m].

    The patch must span enough of the circle to show its bend (h / r > 0.5) and not more than can be seen (h / r < 1).
    """
    bend = np.abs(shape.curvature)
    low, high = 1.0 / radius_range[1], 1.0 / radius_range[0]
    good = (shape.count > 0) & (bend > max(low, 0.5 / shape.scale)) & (bend < min(high, 1.0 / shape.scale))
    good &= bend > _BENT * shape.sigma
    good &= np.abs(shape.second) < np.maximum(_STRAIGHT * bend, 2.0 * shape.sigma)
    good &= (shape.rms < _ROUGH * sigma + _ROUGH_FLOOR) & (shape.inliers > _ONE_SURFACE)
    centres = shape.feet[good] - shape.normals[good] / shape.curvature[good][:, None]
    return Votes(centres, shape.feet[good], shape.directions[good], 1.0 / bend[good], shape.scale)


def line_votes(shape: Surfaces, sigma: float, thickest: float) -> Votes:
    """Votes of the sites whose points lie along a line, for pipes too thin to show a bend: radii up to thickest [m].

    The points of half a pipe spread by at most r / sqrt(2) and the noise across, and by h / sqrt(3) along.
    """
    across = np.sqrt(0.5 * thickest**2 + (1.5 * sigma) ** 2)
    good = (shape.count > 0) & (shape.spread[:, 2] > 0.45 * shape.scale)
    good &= (shape.spread[:, 1] < across) & (shape.spread[:, 1] < 0.5 * shape.spread[:, 2])
    radii = np.full(int(good.sum()), thickest)
    return Votes(shape.centres[good], shape.centres[good], shape.line[good], radii, shape.scale)


def hypotheses_of(votes: Votes) -> list[Hypothesis]:
    """Hypotheses, best supported first: each a cylinder through collinear votes.

    Starts at the vote with the most alike ones around it, grows along the line while refitting it, removes its
    votes, goes on with the rest.
    """
    if len(votes.points) < _LEAST_VOTES:
        return []
    tree = octree.build(votes.points)
    points, directions, radii = tree.points, votes.directions[tree.order], votes.radii[tree.order]
    feet = votes.feet[tree.order]
    around = 2.0 * votes.scale
    level = tree.level_of(around) + 1
    cells = tree.cells(level)
    local = _local_support(points, directions, radii, tree.keys >> (3 * level), cells.keys, cells.starts, level, around)
    alive = np.ones(len(points), bool)
    found: list[Hypothesis] = []
    for start in np.argsort(-local, kind="stable"):
        if local[start] < _LEAST_VOTES:
            break
        if not alive[start]:
            continue
        centre, direction, radius = points[start], directions[start], float(radii[start])
        reach = 3.0 * votes.scale
        members: IntArray = np.zeros(0, np.int64)
        for _ in range(10):
            members, along = _on_line(points, directions, radii, alive, centre, direction, radius, reach)
            members, along = _contiguous(members, along, max(_GAP, 4.0 * votes.scale))
            if len(members) < _LEAST_VOTES:
                break
            radius = float(np.median(radii[members]))
            centre = np.median(points[members], axis=0)
            direction = _direction(points[members], directions[members], direction, radius)
            grown = 2.0 * float(np.abs(along).max())
            if grown <= reach and reach > 3.0 * votes.scale:
                break
            reach = max(1.5 * reach, grown)
        alive[start] = False
        if len(members) < _LEAST_VOTES:
            continue
        alive[members] = False
        along = (points[members] - centre) @ direction
        ends = centre + np.array([along.min() - votes.scale, along.max() + votes.scale])[:, None] * direction
        cylinder = Cylinder(ends[0], ends[1], radius)
        found.append(Hypothesis(cylinder, len(members), _sector(feet[members], cylinder)))
    return sorted(found, key=lambda hypothesis: -hypothesis.votes)


def _sector(feet: FloatArray, cylinder: Cylinder) -> Sector | None:
    """Where the patches lie around the axis: nine tenths of them and some of their width, 50 deg either side at least.

    A patch that reaches into the cleft between two pipes fits no quadric and has no vote, so this sector is clear of
    neighbours: a touching one of the same size begins at 60 deg.
    """
    radial = cylinder.from_axis(feet)
    distance = np.linalg.norm(radial, axis=1)
    if np.median(distance) < 0.5 * cylinder.radius:
        return None
    radial /= np.maximum(distance, 1e-9)[:, None]
    front = radial.mean(axis=0)
    length = float(np.linalg.norm(front))
    if length < _ONE_SIDED:
        return None
    front /= length
    half = np.quantile(np.arccos(np.clip(radial @ front, -1.0, 1.0)), 0.9)
    return Sector(front, max(float(half) + np.radians(10.0), np.radians(50.0)))


def _direction(points: FloatArray, directions: FloatArray, guess: FloatArray, radius: float) -> FloatArray:
    """Direction of a line: of its points where they reach far, of their own directions where they do not."""
    signed = directions * np.sign(directions @ guess)[:, None]
    mean = signed.mean(axis=0)
    mean /= np.linalg.norm(mean)
    offset = points - points.mean(axis=0)
    along = offset @ mean
    lateral = np.linalg.norm(offset - along[:, None] * mean, axis=1)
    # Standard deviations of both estimates: of the directions' mean, and of a line through scattered points.
    own = np.radians(4.0) / np.sqrt(len(points))
    line = max(float(np.median(lateral)), 0.05 * radius) / (float(np.sqrt((along**2).sum())) + 1e-12)
    _, _, axes = np.linalg.svd(offset, full_matrices=False)
    fitted = axes[0] * np.sign(axes[0] @ mean)
    blend = mean / own**2 + fitted / line**2
    return np.asarray(blend / np.linalg.norm(blend))


def _contiguous(members: IntArray, along: FloatArray, gap: float) -> tuple[IntArray, FloatArray]:
    """The members whose positions along the line hang together with the one at 0."""
    if not len(members):
        return members, along
    order = np.argsort(along, kind="stable")
    group = np.cumsum(np.diff(along[order], prepend=along[order[0]]) > gap)
    here = group[int(np.argmin(np.abs(along[order])))]
    keep = order[group == here]
    return members[keep], along[keep]


@njit(cache=True)
def _agree(
    offset: FloatArray, direction: FloatArray, other: FloatArray, radius: float, other_radius: float
) -> tuple[bool, float]:
    along = float(offset @ direction)
    if abs(direction @ other) < _COSINE:
        return False, along
    if radius > _RATIO * other_radius or other_radius > _RATIO * radius:
        return False, along
    lateral = float(offset @ offset) - along * along
    return lateral < (_LATERAL * radius) ** 2, along


@njit(cache=True)
def _local_support(
    points: FloatArray,
    directions: FloatArray,
    radii: FloatArray,
    own_cells: IntArray,
    cell_keys: IntArray,
    cell_starts: IntArray,
    level: int,
    around: float,
) -> IntArray:
    count = np.zeros(len(points), np.int64)
    ranges = np.zeros((27, 2), np.int64)
    found, last = 0, -1
    for i in range(len(points)):
        if own_cells[i] != last:
            last = own_cells[i]
            found = octree.neighbour_ranges(last, cell_keys, cell_starts, level, ranges)
        for r in range(found):
            for j in range(ranges[r, 0], ranges[r, 1]):
                agree, along = _agree(points[j] - points[i], directions[i], directions[j], radii[i], radii[j])
                if agree and abs(along) < around:
                    count[i] += 1
    return count


@njit(cache=True)
def _on_line(
    points: FloatArray,
    directions: FloatArray,
    radii: FloatArray,
    alive: NDArray[np.bool_],
    centre: FloatArray,
    direction: FloatArray,
    radius: float,
    reach: float,
) -> tuple[IntArray, FloatArray]:
    members = np.empty(len(points), np.int64)
    place = np.empty(len(points))
    n = 0
    for j in range(len(points)):
        if not alive[j]:
            continue
        agree, along = _agree(points[j] - centre, direction, directions[j], radius, radii[j])
        if agree and abs(along) < reach:
            members[n] = j
            place[n] = along
            n += 1
    return members[:n].copy(), place[:n].copy()
