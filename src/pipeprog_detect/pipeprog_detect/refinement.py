"""The cloud's candidates before the keyframes: measured by their outlines, kept on trust, or dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.bill import Bill
from pipeprog_detect.classify import classify
from pipeprog_detect.config import ContourConfig
from pipeprog_detect.contour import ContourFit, refine
from pipeprog_detect.extent import Run
from pipeprog_detect.lone_limb import SeenArc
from pipeprog_detect.memory import Memory
from pipeprog_detect.outline import showing, viewing_direction
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.ribbons import DEPTH_SIGMA, covers, laid, mean_centre, propose
from pipeprog_detect.runs import join, spanning
from pipeprog_detect.support import MIN_SUPPORT, outline_support
from pipeprog_detect.verify import Candidate, Evidence

# Outlines of real pipes are supported along more than half of what is seen of them.
CONVINCING = 0.5
# The windows in which outlines are sought follow from the radius: where it changes by more, they are placed anew.
SETTLED, MAX_ROUNDS = 0.1, 3
# Views of a pipe that suffice to tell it from a shadow; to measure it all are used.
FEW_VIEWS = 30
# A planned size so near to a radius that is none is tried, and taken with so much of its outlines' support.
NEAR_PLANNED, AS_GOOD = 0.15, 0.6
# Cloud and outlines contradict each other where their radii differ by so many standard deviations, noise included.
CONTRADICTION = 4.0
# Lines are followed up for so many pipes at most, beside so many of the cloud's points.
MOST_LOST, MOST_POINTS = 40, 600_000
# Without points of the cloud the outlines must be the better seen.
LINES_CONVINCING = 0.6
# What the distance of a pipe found by its lines is known to [m]: its width tells a twentieth, the cloud more.
LINE_DEPTH_SIGMA = 0.03
# Pipes that run within so much of one direction are laid parallel, to so much; two may be so by chance.
NEARLY_PARALLEL, PARALLEL_SIGMA, LEAST_PARALLEL = np.radians(5.0), np.radians(0.3), 3
# The axes of pipes side by side are so many radii apart.
TOUCHING = 2.0
# Shorter than so many radii what the cloud does not resolve may be a hanger, a clamp, or chance.
SLENDER = 20.0
# A strip's edges stay where they are, a cylinder's outlines do not: halfway between, by so many standard deviations.
FLAT, SURELY = 0.5, 2.0
# The cloud resolves a section of five times its noise, seen along a third of the way around, whose radius it knows to a
# twentieth: the edge of a box is round, too, to a cloud.
RESOLVED_RADII, RESOLVED_ARC, RESOLVED_SIGMA = 5.0, np.radians(120.0), 0.05


@dataclass(frozen=True)
class Measured:
    """A candidate after the images were asked: its cylinder and the standard deviation of its radius [m].

    `rims`: what the images say for a rim at its start and at its end (`rim.End.odds`).
    """

    candidate: Candidate
    cylinder: Cylinder
    radius_sigma: float
    rims: tuple[float, float] = (0.0, 0.0)


class Jury:
    """The keyframes, and what they say about candidates; without views the cloud's word stands."""

    def __init__(self, views: Sequence[View], bill: Bill, config: ContourConfig, memory: Memory | None = None) -> None:
        self._views, self._bill, self._config = views, bill, config
        self._memory = memory or Memory()
        self._refused: list[Cylinder] = []

    @property
    def sits(self) -> bool:
        """Whether there are keyframes to judge by."""
        return bool(self._views)

    def vouches_for(self, candidate: Candidate) -> bool:
        """Whether the keyframes make a pipe of a candidate of which the cloud alone is not sure.

        They must show most of its outlines, and these must have a planned size: shadows have outlines, too.
        """
        if any(_alike(candidate.cylinder, refused) for refused in self._refused):
            return False
        views = showing(_places(candidate.cylinder), self._views, FEW_VIEWS)
        fit = self._as_planned(self._refined(candidate, [], views, follow=False), [])
        if fit is None or fit.support < CONVINCING or not self._is_planned(fit):
            self._refused.append(candidate.cylinder)
            return False
        return True

    def measure(self, candidates: Sequence[Candidate], trusted: Sequence[bool]) -> list[Measured]:
        """The candidates measured by their outlines.

        A candidate without outlines stays as the cloud has it only where the cloud vouches for it (`trusted`) and,
        beside keyframes that should have shown it, resolves its section. Those with most points come first; what they
        turn out to be is known when the others are measured.
        """
        order = sorted(range(len(candidates)), key=lambda number: -candidates[number].points)
        current = {number: candidates[number].cylinder for number in order if trusted[number]}
        found: list[Measured] = []
        for number in order:
            candidate = candidates[number]
            others = [cylinder for other, cylinder in current.items() if other != number]
            fit = self._refined(candidate, others, self._views, trusted=trusted[number])
            if fit is None and not (trusted[number] and (not self.sits or _resolved(candidate))):
                continue
            # Where the noise hides the section only the bill tells a thin pipe from the edge of a plate or a corner.
            doubtful = self.sits and (candidate.blurred or not trusted[number])
            if doubtful and (fit is None or not self._is_planned(fit)):
                fit = self._of_planned_size(candidate, others)
                if fit is None:
                    continue
            if self.sits and candidate.blurred and fit is not None and not self._stands_alone(fit.cylinder, others):
                continue
            if not doubtful:
                fit = self._as_planned(fit, others)
            if fit is None:
                measured = Measured(candidate, candidate.cylinder, candidate.radius_sigma)
            elif not self._is_planned(fit) and _contradict(candidate, fit):
                measured = Measured(candidate, *_by_the_cloud(candidate, fit))
            else:
                measured = Measured(candidate, fit.cylinder, fit.radius_sigma, fit.rims)
            middle = 0.5 * (measured.cylinder.start + measured.cylinder.end)
            if not any(_contains(known.cylinder, middle) for known in found):
                current[number] = measured.cylinder
                found.append(measured)
        return found

    def _stands_alone(self, cylinder: Cylinder, others: Sequence[Cylinder]) -> bool:
        """Whether the keyframes alone make a pipe of it: no stub, and no edge of a board or a step for one outline."""
        if _is_stub(cylinder):
            return False
        return outline_support(cylinder, self._views, others).weaker_share >= MIN_SUPPORT

    def _as_planned(self, fit: ContourFit | None, others: Sequence[Cylinder]) -> ContourFit | None:
        """The fit, or one of a planned size near it whose outlines are about as well supported.

        A shadow along a pipe passes for its outline where the cameras never rise or fall. Pipes of sizes that nobody
        planned are rarer than shadows, but where the planned size finds no outlines of its own the fit stands.
        """
        if fit is None or self._is_planned(fit):
            return fit
        radius = fit.cylinder.radius
        planned = [
            one.outer_radius for one in self._bill.classes if abs(one.outer_radius / radius - 1.0) < NEAR_PLANNED
        ]
        for size in planned:
            start = replace(fit.cylinder, radius=size)
            sigma = abs(size - radius)
            again = refine(start, sigma, self._views, others, self._config, (), known_radius=True, ends_known=True)
            if again is not None and self._is_planned(again) and again.support > AS_GOOD * fit.support:
                return again
        return fit

    def _of_planned_size(self, candidate: Candidate, others: Sequence[Cylinder]) -> ContourFit | None:
        """The best seen fit of a planned size that the cloud allows, sought with that radius alone.

        Lines beside a thin pipe, such as its shadow's, pass for its outlines where its size is left open.
        """
        reach = 3.0 * max(candidate.radius_sigma, candidate.evidence.noise)
        sigma, fits = candidate.evidence.noise, []
        for one in self._bill.classes:
            if candidate.blurred and abs(one.outer_radius - candidate.cylinder.radius) < reach:
                start = replace(candidate.cylinder, radius=one.outer_radius)
                fit = refine(start, sigma, self._views, others, self._config, (), known_radius=True, ends_known=True)
                if fit is not None and fit.support > CONVINCING and self._is_planned(fit):
                    fits.append(fit)
        return max(fits, key=lambda fit: fit.support, default=None)

    def measure_lost(
        self, points: NDArray[np.floating], thickest: float, found: Sequence[Measured]
    ) -> tuple[Measured, ...]:
        """Pipes up to `thickest` [m] of which the keyframes show lines and the cloud (N, 3) too little.

        They must have a planned size and most of their outlines, and these must move against each other from view to
        view as a cylinder's do, where the views differ enough to tell.
        """
        thin = [planned.outer_radius for planned in self._bill.classes if planned.outer_radius < thickest]
        if not self.sits or not thin:
            return ()
        some = points[:: -(-len(points) // MOST_POINTS)].astype(np.float32)
        known = [measured.cylinder for measured in found]
        lost: list[Measured] = []
        for proposed in propose(self._views, some, thin, known, MOST_LOST, self._memory.edges):
            if _is_known(proposed, known) or self._is_rival(proposed, lost):
                continue
            fit = self._by_lines(proposed, known, thin, follow=False)
            if fit is not None:
                fit = self._followed(fit, proposed.radius, points, known, thin)
            if fit is None or _is_stub(fit.cylinder) or _is_known(fit.cylinder, known):
                continue
            lost.append(Measured(_seen(fit, points), fit.cylinder, fit.radius_sigma, fit.rims))
            known.append(fit.cylinder)
        return tuple(lost)

    def _is_rival(self, proposed: Cylinder, lost: Sequence[Measured]) -> bool:
        """Whether the keyframes show it where they show one of the lost pipes: two cannot both be there."""
        centre = mean_centre(proposed, self._views)
        return centre is not None and any(covers(each.cylinder, proposed, centre, TOUCHING) for each in lost)

    def _followed(
        self,
        piece: ContourFit,
        radius: float,
        points: NDArray[np.floating],
        known: Sequence[Cylinder],
        radii: Sequence[float],
    ) -> ContourFit | None:
        """The whole of a pipe of the given radius of which a piece was found by its lines.

        Its depth, which lines seen from one height leave open, is that of the cloud's points (N, 3) before the wall.
        """
        slope_known_to = float(np.sqrt(piece.covariance[3, 3]))
        start = replace(piece.cylinder, radius=radius)
        start, slope_sigma = aligned(start, known, self._views, slope_known_to)
        centre = mean_centre(start, self._views)
        sloping = not np.isfinite(slope_sigma)
        at_depth = None if centre is None else laid(start, points.astype(np.float32), centre, sloping)
        depth_sigma = LINE_DEPTH_SIGMA if at_depth is None else DEPTH_SIGMA * radius
        return self._by_lines(at_depth or start, known, radii, depth_sigma, slope_sigma)

    def _by_lines(
        self,
        proposed: Cylinder,
        known: Sequence[Cylinder],
        radii: Sequence[float],
        depth_sigma: float = LINE_DEPTH_SIGMA,
        slope_sigma: float = np.inf,
        follow: bool = True,
    ) -> ContourFit | None:
        """The fit of a pipe proposed by its lines, where it has the outlines of one and a planned size."""
        sigma, views = proposed.radius, self._views
        fit = refine(proposed, sigma, views, known, self._config, radii, follow, True, depth_sigma, slope_sigma)
        if fit is None or fit.support < LINES_CONVINCING or not self._is_planned(fit):
            return None
        return None if fit.flatness - FLAT > SURELY * fit.flatness_sigma else fit

    def _is_planned(self, fit: ContourFit) -> bool:
        return classify(fit.cylinder.radius, fit.radius_sigma, self._bill).probability > 0.0

    def _refined(
        self,
        candidate: Candidate,
        others: Sequence[Cylinder],
        views: Sequence[View],
        follow: bool = True,
        trusted: bool = False,
    ) -> ContourFit | None:
        if not views:
            return None
        planned_radii = [planned.outer_radius for planned in self._bill.classes]
        # The surface may lie as far from its points' mean as they scatter: the cloud's sigma knows of noise alone.
        sigma = max(candidate.radius_sigma, candidate.evidence.noise)
        cylinder = candidate.cylinder
        known, fit = self._memory.recall(cylinder, follow, others, views)
        if known:
            return fit
        seen = SeenArc(candidate.evidence.arc, sigma) if trusted and not candidate.blurred else None
        starts = [cylinder.radius]
        if candidate.blurred:  # the cloud does not know the radius: the planned ones within its reach are tried, too
            starts += [radius for radius in planned_radii if abs(radius - cylinder.radius) < 3.0 * sigma]
        fits = []
        for radius in starts:
            start = replace(cylinder, radius=radius)
            for _ in range(MAX_ROUNDS):
                fit = refine(
                    start, sigma, views, others, self._config, planned_radii, follow, ends_known=True, seen=seen
                )
                if fit is None or abs(fit.cylinder.radius - start.radius) < SETTLED * start.radius:
                    break
                start = _cut(fit.cylinder, cylinder)
            if fit is not None:
                fits.append(fit)
        best = max(fits, key=lambda fit: fit.support, default=None)
        self._memory.keep(cylinder, follow, others, views, best)
        return best


def joined(measured: Sequence[Measured]) -> list[Measured]:
    """Pieces of one pipe made one, as thick as the best measured: the cloud may show one, lines another."""
    whole = []
    for pieces in join([each.cylinder for each in measured]):
        best = min(pieces, key=lambda piece: measured[piece].radius_sigma)
        cylinder = spanning([measured[piece].cylinder for piece in pieces], best=pieces.index(best))
        points = sum(measured[piece].candidate.points for piece in pieces)
        along = sorted(
            (float(end @ cylinder.axis), rim)
            for piece in (measured[number] for number in pieces)
            for end, rim in zip((piece.cylinder.start, piece.cylinder.end), piece.rims, strict=True)
        )
        candidate, rims = replace(measured[best].candidate, points=points), (along[0][1], along[-1][1])
        whole.append(Measured(candidate, cylinder, measured[best].radius_sigma, rims))
    return whole


def _places(cylinder: Cylinder) -> FloatArray:
    """Points (9, 3) along the axis."""
    return cylinder.start + np.linspace(0.0, 1.0, 9)[:, None] * (cylinder.end - cylinder.start)


def _is_stub(cylinder: Cylinder) -> bool:
    return cylinder.length < SLENDER * cylinder.radius


def _is_known(cylinder: Cylinder, known: Sequence[Cylinder]) -> bool:
    """Whether the middle of the cylinder lies within a known one."""
    return any(_contains(other, 0.5 * (cylinder.start + cylinder.end)) for other in known)


def aligned(
    proposed: Cylinder, known: Sequence[Cylinder], views: Sequence[View], slope_known_to: float
) -> tuple[Cylinder, float]:
    """The cylinder as parallel to the known ones of nearly its direction as its image allows, and how sure [rad].

    Seen from one height alone, a level pipe may as well slope towards the cameras: what else runs there tells, as far
    as it differs by no more than the cylinder's own slope may be wrong, `slope_known_to` [rad].
    """
    middle = 0.5 * (proposed.start + proposed.end)
    across = np.cross(proposed.axis, viewing_direction(proposed, views))
    across = across / np.linalg.norm(across)
    towards = np.cross(across, proposed.axis)
    axes = np.array([other.axis * np.sign(other.axis @ proposed.axis) for other in known]).reshape(-1, 3)
    steepest = max(np.tan(NEARLY_PARALLEL), 3.0 * slope_known_to)
    slope = np.abs(axes @ towards) / (axes @ proposed.axis)
    axes = axes[(np.abs(axes @ across) < np.sin(NEARLY_PARALLEL)) & (slope < steepest)]
    if len(axes) < LEAST_PARALLEL:
        return proposed, np.inf
    direction = np.median(axes, axis=0)
    spread = float(np.median(np.linalg.norm(axes - direction, axis=1)))
    direction = direction - (direction @ across) * across
    half = 0.5 * proposed.length * direction / np.linalg.norm(direction)
    return Cylinder(middle - half, middle + half, proposed.radius), max(spread, PARALLEL_SIGMA)


def _seen(fit: ContourFit, points: NDArray[np.floating]) -> Candidate:
    """The candidate that stands for a pipe found by its lines, with what the cloud (N, 3) holds of it."""
    cylinder = fit.cylinder
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    near = (along > 0) & (along < cylinder.length)
    offset, along = offset[near], along[near]
    distance = np.linalg.norm(offset - along[:, None] * cylinder.axis, axis=1) - cylinder.radius
    distance = distance[np.abs(distance) < cylinder.radius]
    noise = float(np.sqrt(np.mean(distance**2))) if len(distance) else cylinder.radius
    evidence = Evidence(np.pi, fit.support, 0.0, noise, 0.0, 1.0)
    return Candidate(cylinder, fit.radius_sigma, len(distance), [Run(0.0, cylinder.length)], evidence)


def _contains(cylinder: Cylinder, point: FloatArray) -> bool:
    along = float((point - cylinder.start) @ cylinder.axis)
    off_axis = point - cylinder.start - along * cylinder.axis
    return 0.0 < along < cylinder.length and float(off_axis @ off_axis) < cylinder.radius**2


def _alike(one: Cylinder, other: Cylinder) -> bool:
    """Whether two candidates would be judged alike: the same place and size but for a tenth of the radius."""
    tolerance = 0.1 * other.radius
    if abs(one.radius - other.radius) > tolerance:
        return False
    same = max(np.linalg.norm(one.start - other.start), np.linalg.norm(one.end - other.end))
    turned = max(np.linalg.norm(one.start - other.end), np.linalg.norm(one.end - other.start))
    return bool(min(same, turned) < max(tolerance, 0.1 * other.length))


def _contradict(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether the outlines give a radius that a cloud which resolves the section cannot have.

    Where the cameras never rise or fall, the edge of the light along a pipe passes for its outline.
    """
    sigma = np.linalg.norm([candidate.radius_sigma, candidate.evidence.noise, fit.radius_sigma])
    return _resolved(candidate) and bool(abs(fit.cylinder.radius - candidate.cylinder.radius) > CONTRADICTION * sigma)


def _by_the_cloud(candidate: Candidate, fit: ContourFit) -> tuple[Cylinder, float]:
    """The cloud's cylinder between the ends that the keyframes show, and the standard deviation of its radius [m]."""
    sigma = float(np.hypot(candidate.radius_sigma, candidate.evidence.noise))
    return _cut(candidate.cylinder, fit.cylinder), sigma


def _cut(line: Cylinder, ends: Cylinder) -> Cylinder:
    """The cylinder `line` with the ends of another one, projected."""
    low, high = sorted(float((end - line.start) @ line.axis) for end in (ends.start, ends.end))
    return Cylinder(line.start + low * line.axis, line.start + high * line.axis, line.radius)


def _resolved(candidate: Candidate) -> bool:
    evidence, radius = candidate.evidence, candidate.cylinder.radius
    known = candidate.radius_sigma < RESOLVED_SIGMA * radius
    return known and radius > RESOLVED_RADII * evidence.noise and evidence.arc > RESOLVED_ARC
