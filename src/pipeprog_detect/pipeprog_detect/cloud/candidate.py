# SPDX-License-Identifier: Apache-2.0
"""From a hypothesis to a measured cylinder with the evidence for and against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.axial_extent import Interval, longest_gap, straight_interval, surface_intervals
from pipeprog_detect.cloud.axis_voting import Hypothesis, Sector
from pipeprog_detect.cloud.cylinder_fit import CylinderFit, basis, covered_arc, fit_cylinder, quick_fit
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.types import Cylinder

# Points of one fit while a pipe is followed, of the search for its ends, and of the last fit; they bound the time.
# Noise of 3 mm over the root of 2500 is 0.06 mm, less than the bend of the cloud leaves.
_FIT_POINTS, _FOLLOW_POINTS, _FINAL_POINTS = 2500, 20_000, 12_000
# Fewer points on a surface than this make no candidate: six for each unknown of a cylinder.
_LEAST_POINTS = 30
# Width of the band that counts as one standard deviation of the points about a surface: a multiple of the noise and a
# floor [m]. Stereo's errors have longer tails than Gaussian ones (hence 1.2), and clouds are wavy by fractions of a
# millimetre. At first the noise is the cloud's; while a pipe is followed its own, within the limits of _LEAST_BAND and
# _MOST_BAND: surfaces seen head-on are rougher than the median one, those seen aslant smoother. The values were set
# on generated sites; no more than their order follows from the noise.
_START_BAND, _LEAST_BAND, _MOST_BAND = (1.2, 5e-4), (0.7, 3e-4), (1.6, 7e-4)
_OWN_BAND = (1.2, 2e-4)
# Noise above this share of the radius blurs half a circle into a blob whose circle fit is far too small.
_BLURRED = 0.16
# Clouds are bent by about a millimetre over decimetres; a fifth of that remains on the radius [m].
_BENT_CLOUD = 2e-4
# Of a blurred pipe: noise across the ray over the spread about the surface (a third of that along the ray for a
# scanner, as much for a fused cloud: in between); variance of the coordinate across, in r^2 (see _by_width); least
# share of the measured variance that the noise leaves; relative standard deviation of the radius by what part is seen.
_BLURRED_ACROSS, _BLURRED_VARIANCE, _BLURRED_LEAST, _BLURRED_SIGMA = 0.65, 0.355, 0.25, 0.1
# The share of the noise across is known to a third of it, that of its square to 1.5 times half of it.
_BLURRED_NOISE_SIGMA = 1.5 * 0.5
# A flange or a cap covers this length of an end [m], beside what the noise smears: points of it are not fitted.
_CAP = 0.015
# A stretch of surface that continues a pipe beyond a gap is as long as this share of it at least: less is chance.
_BRIDGING = 0.25
# Shorter pieces of surface [m] (or than half a radius) are stray points.
_LEAST_PIECE = 0.015


@dataclass(frozen=True)
class CloudEvidence:
    """What speaks for and against a cylinder.

    arc [rad]: widest stretch of the circumference seen; coverage: share of the length that shows surface; inside:
    points within the barrel, well under its surface, per point on it; noise [m]: spread of the points across the
    surface; roundness [m]: root mean square over the sectors of the section of their mean distance from the circle,
    0 for a true one; flatness: mean square from the best plane over the mean square from the cylinder.
    """

    arc: float
    coverage: float
    inside: float
    noise: float
    roundness: float
    flatness: float


@dataclass(frozen=True)
class Candidate:
    """A measured cylinder, standard deviation of its radius [m], number of points on its surface, evidence.

    Where the radius is held, it is one that was given, with the standard deviation that the cloud alone would leave.
    """

    cylinder: Cylinder
    radius_sigma: float
    points: int
    evidence: CloudEvidence
    radius_held: bool = False

    @property
    def blurred(self) -> bool:
        """Whether the noise hides the section: a thin pipe and the edge of a plate look the same."""
        return self.evidence.noise > _BLURRED * self.cylinder.radius

    @property
    def band(self) -> float:
        """Width [m] that counts as one standard deviation when points are taken for its surface."""
        return _band(self.evidence.noise, _OWN_BAND)

    @property
    def arc_sigma(self) -> float:
        """Standard deviation of the radius [m] where the ends of the arc may lie as far out as its points scatter.

        Stereo spreads a surface outwards where it is seen at a slant: at both ends of an arc, which is then flatter.
        """
        if self.radius_held:
            return self.radius_sigma
        return float(np.hypot(self.radius_sigma, _spread_of_arc(self.evidence)))


def fit_candidate(
    tree: Octree, free: NDArray[np.bool_], hypothesis: Hypothesis, sigma: float, *, hold_radius: bool = False
) -> Candidate | None:
    """Fit a hypothesis to the points of the tree that are free (N,), and follow it along its axis to its ends.

    Only the sector that voted for it is fitted: beside it a neighbour may begin, which is not known yet.
    sigma [m] is the cloud's typical noise; a pipe's own may be up to 1.6 times that (head-on surfaces, waviness).
    Its radius may be held, where the cloud does not tell it.
    """
    wide = _band(sigma, _START_BAND)
    initial = cylinder = hypothesis.cylinder
    for turn in range(12):
        axis = cylinder.axis
        step = max(0.5 * cylinder.length, (1.0 + _BRIDGING) * longest_gap(cylinder.radius)) if turn else 0.0
        # Hypotheses are right to a tenth of the radius; a wider reach would take in the neighbour of a rack.
        reach = 1.0 + 0.1 * cylinder.radius / wide if turn == 0 else 1.2
        rows = tree.near_segment(
            cylinder.start - step * axis, cylinder.end + step * axis, cylinder.radius + 4.0 * wide * reach
        )
        points = _spread_out(tree.points[rows[free[rows]]], _FOLLOW_POINTS)
        if len(points) < _LEAST_POINTS:
            return None
        grown = np.inf
        if turn:
            intervals = _visible_intervals(points, cylinder, wide)
            if not intervals:
                return None
            low, high = intervals[0].low, intervals[-1].high
            grown = max(-low, high - cylinder.length)
            cylinder = cylinder.cut(low, high)
            points = _between(points, cylinder, Interval(0.0, cylinder.length))
        facing = _spread_out(_facing(points, cylinder, hypothesis.sector), _FIT_POINTS)
        fit = quick_fit(facing, cylinder, wide, reach, free_radius=not hold_radius)
        if fit is None or not 0.6 * initial.radius < fit[0].radius < 1.6 * initial.radius:
            return None
        fitted, rmse = fit
        wide = float(np.clip(1.2 * rmse, _band(sigma, _LEAST_BAND), _band(sigma, _MOST_BAND)))
        cylinder = fitted if turn == 0 else fitted.cut_like(cylinder)
        if grown < 0.02 and turn >= 2:
            break
    margin = cylinder.radius * cylinder.axis
    rows = tree.near_segment(cylinder.start - margin, cylinder.end + margin, 1.5 * cylinder.radius + 6.0 * wide)
    return refit(tree.points[rows[free[rows]]], cylinder, wide, sector=hypothesis.sector, hold_radius=hold_radius)


def refit(
    points: FloatArray,
    cylinder: Cylinder,
    wide: float,
    *,
    whole: bool = False,
    sector: Sector | None = None,
    hold_radius: bool = False,
) -> Candidate | None:
    """Measure a cylinder that is nearly right on the points (N, 3) around it, all of which are its own or nobody's.

    Points within three times `wide` [m] are its surface. A `whole` cylinder is known to be one pipe between its ends,
    whatever the gaps; otherwise it is followed as far as it is straight and its gaps are such as a clamp explains.
    Where a sector is given, only that is fitted. Its radius may be held.
    """
    near = points[np.abs(_signed_distance(points, cylinder)) < max(5.0 * wide, 0.2 * cylinder.radius)]
    # A cap closes the end: its points lie within the barrel all around, and would draw the radius in.
    body = _facing(_between(near, cylinder, _without_caps(cylinder, wide)), cylinder, sector)
    held = cylinder.radius if hold_radius else None
    fit = fit_cylinder(_spread_out(body, _FINAL_POINTS), cylinder, wide, reach=1.0, fixed_radius=held)
    if fit is None:
        return None
    # What the residuals do not show: third orders of the noise, and a bend of the cloud that is alike all along.
    radius_sigma = float(np.linalg.norm([fit.radius_sigma, 0.5 * fit.rmse**2 / fit.cylinder.radius, _BENT_CLOUD]))
    if fit.rmse > _BLURRED * cylinder.radius and not hold_radius:
        fit, radius_sigma = _by_width(body, cylinder, fit, wide)
    cylinder = fit.cylinder.cut_like(cylinder)
    intervals = _covered_intervals(near, cylinder, wide) if whole else _visible_intervals(near, cylinder, wide)
    if not intervals:
        return None
    cut = cylinder.cut(intervals[0].low, intervals[-1].high)
    surface = _between(near, cut, Interval(0.0, cut.length))
    surface = surface[np.abs(_signed_distance(surface, cut)) < 3.0 * wide]
    if len(_between(surface, cut, _without_caps(cut, wide))) < _LEAST_POINTS:
        return None
    coverage = sum(interval.length for interval in intervals) / cut.length
    evidence = _evidence(points, cut, surface, wide, coverage)
    if hold_radius:
        radius_sigma = float(np.hypot(radius_sigma, _spread_of_arc(evidence)))
    return Candidate(cut, radius_sigma, len(surface), evidence, hold_radius)


def thin_pipe_start(
    tree: Octree, free: NDArray[np.bool_], line: Cylinder, sigma: float, radii: Sequence[float]
) -> Cylinder | None:
    """The cylinder, of those of the given radii about a line through the points of a thin pipe, that explains most.

    The line runs through the mean of the points, that is before the axis by about half a radius on a side that is
    not known: each of eight sides is tried.
    """
    u, v = basis(line.axis)
    rows = tree.near_segment(line.start, line.end, 2.5 * max(radii) + 4.0 * sigma)
    points = _spread_out(tree.points[rows[free[rows]]], 1500)
    best, most = None, 0.0
    for radius in radii:
        for angle in np.arange(8) * (np.pi / 4):
            shift = 0.6 * radius * (np.cos(angle) * u + np.sin(angle) * v)
            initial = Cylinder(line.start + shift, line.end + shift, radius)
            fit = quick_fit(points, initial, sigma, 1.0)
            if fit is None or not 0.5 * min(radii) < fit[0].radius < 1.5 * max(radii):
                continue
            share = np.clip(1.0 - (_signed_distance(points, fit[0]) / (4.0 * sigma)) ** 2, 0.0, None)
            worth = float((share**2).sum())
            if worth > most:
                best, most = fit[0], worth
    return best


def own_points(points: FloatArray, cylinder: Cylinder, others: Sequence[Cylinder]) -> FloatArray:
    """The points (N, 3) that lie no nearer to the surface of one of the others than to the cylinder's."""
    mine = np.abs(_signed_distance(points, cylinder))
    keep = np.ones(len(points), bool)
    for other in others:
        along = other.along(points)
        theirs = _signed_distance(points, other)
        # What lies within another barrel is its too: nothing passes through a pipe.
        keep &= ~((along > 0) & (along < other.length) & (theirs < mine))
    return points[keep]


def _by_width(points: FloatArray, cylinder: Cylinder, fit: CylinderFit, wide: float) -> tuple[CylinderFit, float]:
    """Fit at the radius that the width of a blurred pipe's points tells, and that radius's standard deviation [m].

    Over a half of the circumference seen, up to 70 or 75 deg from the front, the points' coordinate across has a
    variance of 0.31 r^2 where a scanner's rays meet it (evenly over the width) and of 0.40 r^2 where the points lie
    evenly on the surface; the noise across the ray, a third of that along it for a scanner, as much for a fused
    cloud, adds to that. Both are taken in between.
    """
    lateral = fit.cylinder.from_axis(points)
    near = lateral[np.linalg.norm(lateral, axis=1) < 2.0 * cylinder.radius + 2.0 * wide]
    if len(near) < 50:
        return fit, fit.cylinder.radius
    for _ in range(3):
        centred = near - np.median(near, axis=0)
        values, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
        along = centred @ vectors[:, 2]
        near = near[np.abs(along) < 2.5 * np.sqrt(values[2])]
    noise = _BLURRED_ACROSS * fit.rmse
    square = max(float(values[2]) - noise**2, _BLURRED_LEAST * float(values[2]))
    radius = float(np.sqrt(square / _BLURRED_VARIANCE))
    again = fit_cylinder(
        _spread_out(points, _FINAL_POINTS), replace(cylinder, radius=radius), wide, reach=1.0, fixed_radius=radius
    )
    # The share of the noise across is known to a third of it; a part hidden takes up to a fifth off the width.
    sigma = float(np.hypot(_BLURRED_SIGMA * radius, _BLURRED_NOISE_SIGMA * noise**2 / radius))
    return (again or fit), sigma


def _evidence(
    points: FloatArray, cylinder: Cylinder, surface: FloatArray, wide: float, coverage: float
) -> CloudEvidence:
    body = _without_caps(cylinder, wide)
    surface = _between(surface, cylinder, body)
    distance = _signed_distance(surface, cylinder)
    inside = float((_signed_distance(_between(points, cylinder, body), cylinder) < -4.0 * wide).sum()) / len(surface)
    offset = surface - surface.mean(axis=0)
    lateral = offset - (offset @ cylinder.axis)[:, None] * cylinder.axis
    values = np.linalg.eigvalsh(lateral.T @ lateral / len(lateral))
    square = float(np.mean(distance**2))
    return CloudEvidence(
        arc=covered_arc(surface, cylinder),
        coverage=coverage,
        inside=inside,
        noise=float(np.sqrt(square)),
        roundness=_roundness(surface, cylinder, distance),
        flatness=float(values[1]) / max(square, 1e-12),
    )


def _spread_of_arc(evidence: CloudEvidence) -> float:
    """By how much the radius changes [m] where both ends of the arc move out by what the points scatter."""
    return float(evidence.noise / (1.0 - np.cos(0.5 * min(evidence.arc, np.pi))))


def _roundness(points: FloatArray, cylinder: Cylinder, distance: FloatArray, sectors: int = 36) -> float:
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    sector = ((np.arctan2(offset @ v, offset @ u) + np.pi) * (sectors / (2 * np.pi))).astype(int) % sectors
    count = np.bincount(sector, minlength=sectors)
    mean = np.bincount(sector, weights=distance, minlength=sectors) / np.maximum(count, 1)
    # What the noise of a sector's mean adds is taken out.
    own = np.var(distance) / np.maximum(count, 1)
    square = np.average(mean**2 - own, weights=count)
    return float(np.sqrt(max(square, 0.0)))


def _facing(points: FloatArray, cylinder: Cylinder, sector: Sector | None) -> FloatArray:
    if sector is None:
        return points
    radial = cylinder.from_axis(points)
    return points[radial @ sector.front > np.cos(sector.half) * np.linalg.norm(radial, axis=1)]


def _band(noise: float, law: tuple[float, float]) -> float:
    """Width [m] of the band for points of this noise [m]: law[0] times the noise and law[1] [m]."""
    slope, floor = law
    return slope * noise + floor


def _signed_distance(points: FloatArray, cylinder: Cylinder) -> FloatArray:
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    square = np.einsum("ij,ij->i", offset, offset) - along**2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)) - cylinder.radius)


def _visible_intervals(points: FloatArray, cylinder: Cylinder, wide: float) -> list[Interval]:
    """Stretches of the axis that show surface and lie on one line, without an elbow at an end."""
    distance = np.abs(_signed_distance(points, cylinder))
    skin = distance < 3.0 * wide
    if skin.sum() < _LEAST_POINTS:
        return []
    # An elbow that leaves a narrow band shows its front only, which does not tell where it went.
    straight = straight_interval(points[distance < max(3.0 * wide, 0.2 * cylinder.radius)], cylinder, wide)
    if straight is None:
        return []
    return _connected_intervals(
        surface_intervals(_between(points[skin], cylinder, straight), cylinder),
        longest_gap(cylinder.radius),
        cylinder.radius,
    )


def _covered_intervals(points: FloatArray, cylinder: Cylinder, wide: float) -> list[Interval]:
    """Stretches between the cylinder's ends that show surface."""
    skin = points[np.abs(_signed_distance(points, cylinder)) < 3.0 * wide]
    intervals = surface_intervals(_between(skin, cylinder, Interval(0.0, cylinder.length)), cylinder)
    return [interval for interval in intervals if interval.length > max(0.5 * cylinder.radius, _LEAST_PIECE)]


def _connected_intervals(intervals: list[Interval], gap: float, radius: float) -> list[Interval]:
    """The intervals of one pipe: the longest one and its neighbours on either side, up to the first gap too long."""
    intervals = [interval for interval in intervals if interval.length > max(0.5 * radius, _LEAST_PIECE)]
    if not intervals:
        return []
    first = last = int(np.argmax([interval.length for interval in intervals]))
    while first > 0 and _bridged(intervals[first - 1], intervals[first].low - intervals[first - 1].high, gap, radius):
        first -= 1
    while last + 1 < len(intervals) and _bridged(
        intervals[last + 1], intervals[last + 1].low - intervals[last].high, gap, radius
    ):
        last += 1
    return intervals[first : last + 1]


def _bridged(interval: Interval, gap: float, most: float, radius: float) -> bool:
    return gap < min(most, max(interval.length / _BRIDGING, radius))


def _without_caps(cylinder: Cylinder, wide: float) -> Interval:
    cap = min(5.0 * wide + _CAP, 0.2 * cylinder.length)
    return Interval(cap, cylinder.length - cap)


def _between(points: FloatArray, cylinder: Cylinder, interval: Interval) -> FloatArray:
    along = cylinder.along(points)
    return points[(along >= interval.low) & (along <= interval.high)]


def _spread_out(points: FloatArray, most: int) -> FloatArray:
    """At most `most` of the points, evenly along the Morton curve and so in space."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(np.int64)]
