# SPDX-License-Identifier: Apache-2.0
"""A candidate as the keyframes measured it, and collinear pieces joined to one pipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.cloud.collinear import join, spanning
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.free_space import SHORTEST, free_stretches
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, PipeEnd, View
from pipeprog_detect.verification.radius_agreement import agree
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.walls_across import stretches_in_walls

# What the cloud does not resolve is no pipe if it is shorter than this many radii: hangers and clamps are.
SLENDER = 20.0
# Pieces of one pipe have one radius, to four standard deviations and the tolerance of manufacture (1 %, EN 10255).
SAME_RADIUS, MANUFACTURE = 4.0, 0.01
# And one axis, to as many of them. A pipe may be bent by 0.15 % of its length (EN 10216-1): two lines along parts of an
# arc aim past each other by two thirds of its rise at the most, which is taken as three standard deviations.
SAME_AXIS, STRAIGHT = 4.0, 0.0015 * 2.0 / 9.0
# Logarithm of the odds from which evidence is called decisive (Jeffreys: a hundred to one), for each of the forty lines
# of a map that are tried (Bonferroni; `thin_pipes.MOST_PROPOSED`).
DECISIVE = float(np.log(100.0 * 40.0))


@dataclass(frozen=True)
class MeasuredPipe:
    """A candidate after the keyframes: its cylinder and the standard deviation of its radius [m].

    `rims`: evidence for an end rim at its start and at its end (`pipe_ends.End.odds`). `ends`: its start and its end,
    once all pipes are known. `fit`: of its contour, where that has measured it.
    """

    candidate: Candidate
    cylinder: Cylinder
    radius_sigma: float
    rims: tuple[float, float] = (0.0, 0.0)
    ends: tuple[PipeEnd, PipeEnd] = (PipeEnd(), PipeEnd())
    fit: ContourFit | None = None

    @classmethod
    def of_contour(cls, candidate: Candidate, fit: ContourFit) -> MeasuredPipe:
        """The cylinder that the contour says."""
        return cls(candidate, fit.cylinder, fit.radius_sigma, fit.rims, fit=fit)

    @classmethod
    def of_cloud(cls, candidate: Candidate) -> MeasuredPipe:
        """The candidate as the cloud has it."""
        return cls(candidate, candidate.cylinder, candidate.radius_sigma)

    @classmethod
    def between_ends_of(cls, candidate: Candidate, fit: ContourFit) -> MeasuredPipe:
        """The cloud's cylinder between the ends that the keyframes show; the sigma includes the cloud's noise."""
        sigma = float(np.hypot(candidate.radius_sigma, candidate.evidence.noise))
        return cls(candidate, candidate.cylinder.cut_like(fit.cylinder), sigma)

    def part(self, low: float, high: float) -> Candidate:
        """The candidate for the part of it between two positions [m from its start]."""
        points = int((high - low) / self.cylinder.length * self.candidate.points)
        return replace(self.candidate, cylinder=self.cylinder.cut(low, high), points=points)

    @property
    def is_as_in_cloud(self) -> bool:
        """Whether the cloud resolves the section and has the radius of the contour."""
        return self.fit is not None and agree(self.candidate, self.fit)


def joined(
    measured: Sequence[MeasuredPipe],
    views: Sequence[View],
    overlapping: bool = False,
    context: SceneContext | None = None,
) -> list[MeasuredPipe]:
    """The pipes with collinear pieces joined; the radius is that of the piece with the least standard deviation.

    Pieces of two radii, or of two axes by their contours, are two pipes, and so are those between which the views see
    what is behind them, or a wall of the `context` closes around the axis. Only those that lie within each other, or
    whose gap is shorter than what the views can see through, are joined where `overlapping` is asked for.
    """
    whole = []
    for pieces in _without_gaps(join([each.cylinder for each in measured]), measured, views, overlapping, context):
        best = min(pieces, key=lambda piece: measured[piece].radius_sigma)
        cylinder = spanning([measured[piece].cylinder for piece in pieces], best=pieces.index(best))
        # Of a thin pipe the cloud shows too little to tell one piece from a line of something else.
        shown = [piece for piece in pieces if piece == best or not measured[piece].candidate.blurred]
        in_cloud = spanning([measured[piece].candidate.cylinder for piece in shown], best=shown.index(best))
        points = sum(measured[piece].candidate.points for piece in pieces)
        along = sorted(
            (float(end @ cylinder.axis), rim)
            for piece in (measured[number] for number in pieces)
            for end, rim in zip((piece.cylinder.start, piece.cylinder.end), piece.rims, strict=True)
        )
        candidate = replace(measured[best].candidate, cylinder=in_cloud, points=points)
        whole.append(MeasuredPipe(candidate, cylinder, measured[best].radius_sigma, (along[0][1], along[-1][1])))
    return whole


def _without_gaps(
    groups: Sequence[Sequence[int]],
    measured: Sequence[MeasuredPipe],
    views: Sequence[View],
    overlapping: bool,
    context: SceneContext | None,
) -> list[list[int]]:
    """The groups of collinear pieces, parted where two neighbours on the axis are not one pipe."""
    parted = []
    for group in groups:
        axis = measured[group[0]].cylinder.axis
        ordered = sorted(group, key=lambda piece: float(measured[piece].cylinder.middle @ axis))
        part = [ordered[0]]
        for piece in ordered[1:]:
            before, after = measured[part[-1]], measured[piece]
            if (overlapping and not _overlap(before, after)) or not _continues(before, after, views, context):
                parted.append(part)
                part = []
            part.append(piece)
        parted.append(part)
    return parted


def _continues(one: MeasuredPipe, other: MeasuredPipe, views: Sequence[View], context: SceneContext | None) -> bool:
    """Whether two collinear pieces may be one pipe.

    They have one radius and one axis, and there is no wall nor a free gap between them.
    """
    sigma = float(np.hypot(one.radius_sigma, other.radius_sigma))
    allowed = SAME_RADIUS * sigma + MANUFACTURE * one.cylinder.radius
    if abs(one.cylinder.radius - other.cylinder.radius) > allowed:
        return False
    ends = [(a, b) for a in (one.cylinder.start, one.cylinder.end) for b in (other.cylinder.start, other.cylinder.end)]
    start, end = min(ends, key=lambda pair: float(np.linalg.norm(pair[0] - pair[1])))
    gap = Cylinder(start, end, one.cylinder.radius)
    if gap.length <= SHORTEST:
        return True
    if not _is_on_one_axis(one, other, gap):
        return False
    with_ends = gap.cut(-2.0 * gap.radius, gap.length + 2.0 * gap.radius)  # the pieces may end at the walls
    return not (context and stretches_in_walls(with_ends, context, views, [])) and not free_stretches(gap, views, [])


def _is_on_one_axis(one: MeasuredPipe, other: MeasuredPipe, gap: Cylinder) -> bool:
    """Whether the axes that two contours tell, continued to the middle of the `gap` between them, may be one."""
    if one.fit is None or other.fit is None:
        return True
    fits = (one.fit.on(gap), other.fit.on(gap))
    bent = STRAIGHT * (one.cylinder.length + gap.length + other.cylinder.length)
    covariance = bent**2 * np.eye(3) + sum(fit.across.T @ fit.covariance[:2, :2] @ fit.across for fit in fits)
    across = one.fit.across
    offset = across @ (one.cylinder.from_axis(gap.middle[None])[0] - other.cylinder.from_axis(gap.middle[None])[0])
    square = offset @ np.linalg.solve(across @ covariance @ across.T, offset)
    return bool(square < SAME_AXIS**2)


def _overlap(one: MeasuredPipe, other: MeasuredPipe) -> bool:
    """Whether two collinear pieces lie within each other along the first one's axis, or nearly so."""
    ends = one.cylinder.along(np.stack([other.cylinder.start, other.cylinder.end]))
    return bool(ends.min() < one.cylinder.length + SHORTEST and ends.max() > -SHORTEST)


def is_stub(cylinder: Cylinder) -> bool:
    """Whether it is too short for a pipe that the cloud does not resolve."""
    return cylinder.length < SLENDER * cylinder.radius


def is_known(cylinder: Cylinder, known: Sequence[Cylinder]) -> bool:
    """Whether the middle of the cylinder lies within a known one."""
    return any(other.contains(cylinder.middle) for other in known)


def own_contours(cylinders: Sequence[Cylinder], views: Sequence[View]) -> NDArray[np.bool_]:
    """Mask (N,) of the cylinders whose contours are their own once all of them are known.

    A cylinder that was measured before the one that hides it was found may have been fitted to that one's edges:
    without them its support falls below `MIN_SUPPORT`. One that never had that support is not judged by it.
    """
    kept = np.ones(len(cylinders), bool)
    for number, cylinder in enumerate(cylinders):
        others = [other for k, other in enumerate(cylinders) if k != number and kept[k]]
        if Scene.of(cylinder, views, others).support().share < MIN_SUPPORT:
            kept[number] = Scene.of(cylinder, views, []).support().share < MIN_SUPPORT
    return kept


def is_probable(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> bool:
    """Whether edges that are none of the `others`' support both sides, decisively more often than texture would."""
    support = Scene.of(cylinder, views, others).own_support()
    return float(support.log_odds().sum()) > DECISIVE and support.weaker_share >= MIN_SUPPORT


def is_shown(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> bool:
    """Whether edges support what the `others` leave visible of it, decisively more often than texture would."""
    return float(Scene.of(cylinder, views, others).support().log_odds().sum()) > DECISIVE


def lacks_a_side(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> bool:
    """Whether one side, as far as the `others` leave it visible, decisively shows no edges."""
    return float(Scene.of(cylinder, views, others).support().log_odds().sum(axis=0).min()) < -DECISIVE
