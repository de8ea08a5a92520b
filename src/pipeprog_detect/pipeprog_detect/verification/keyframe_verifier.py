"""The cloud's candidates before the keyframes: measured by their outlines, kept on trust, or dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.config import ContourConfig
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import is_planned
from pipeprog_detect.silhouette.apparent_contour import showing
from pipeprog_detect.silhouette.contour_refinement import ContourFit, Start, refine
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT, outline_support
from pipeprog_detect.silhouette.one_sided import SeenArc
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import Measured, is_known, is_stub
from pipeprog_detect.verification.measurement_cache import Memory

# Outlines of real pipes are supported along more than half of what is seen of them.
CONVINCING = 0.5
# The windows in which outlines are sought follow from the radius: where it changes by more, they are placed anew.
SETTLED, MAX_ROUNDS = 0.1, 3
# Views of a pipe that suffice to tell it from a shadow; to measure it all are used.
FEW_VIEWS = 30
# A planned size so near to a radius that is none is tried, and taken with so much of its outlines' support.
NEAR_PLANNED, AS_GOOD = 0.15, 0.6
# Cloud and outlines contradict each other where their radii differ by so many standard deviations, noise included, ...
CONTRADICTION = 4.0
# ... and agree where they differ by no more than so many without it.
AGREEMENT = 2.0
# The cloud resolves a section of five times its noise, seen along a third of the way around, whose radius it knows to a
# twentieth: the edge of a box is round, too, to a cloud. Two faces lie a tenth of the radius off the circle along both:
# what is three times as smooth is round wherever it is seen.
RESOLVED_RADII, RESOLVED_ARC, RESOLVED_SIGMA = 5.0, np.radians(120.0), 0.05
ROUND_RADII = 30.0


class Jury:
    """The keyframes, and what they say about candidates; without views the cloud's word stands."""

    def __init__(
        self, views: Sequence[View], boq: BillOfQuantities, config: ContourConfig, memory: Memory | None = None
    ) -> None:
        self._views, self._boq, self._config = views, boq, config
        self._memory = memory or Memory()
        self._refused: list[Cylinder] = []

    @property
    def sits(self) -> bool:
        """Whether there are keyframes to judge by."""
        return bool(self._views)

    def vouches_for(self, candidate: Candidate) -> bool:
        """Whether the keyframes make a pipe of a candidate of which the cloud alone is not sure.

        They must show most of its outlines, and these must have a planned size: shadows have outlines, too. Where the
        cloud resolves its section and has that size as well, what others leave of its outlines suffices.
        """
        if any(_alike(candidate.cylinder, refused) for refused in self._refused):
            return False
        views = showing(_places(candidate.cylinder), self._views, FEW_VIEWS)
        fit = self._as_planned(self._refined(candidate, [], views, follow=False), [])
        vouched = (
            fit is not None
            and is_planned(fit.cylinder.radius, fit.radius_sigma, self._boq)
            and (fit.support > CONVINCING or _agree(candidate, fit))
        )
        if not vouched:
            self._refused.append(candidate.cylinder)
        return vouched

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
            # Where the noise hides the section only the planned radii tell a thin pipe from the edge of a plate.
            doubtful = self.sits and (candidate.blurred or not trusted[number])
            if doubtful and (fit is None or not is_planned(fit.cylinder.radius, fit.radius_sigma, self._boq)):
                fit = self._of_planned_size(candidate, others)
                if fit is None:
                    continue
            if self.sits and candidate.blurred and fit is not None and not self._stands_alone(fit.cylinder, others):
                continue
            if not doubtful:
                fit = self._as_planned(fit, others)
            if fit is None:
                measured = Measured(candidate, candidate.cylinder, candidate.radius_sigma)
            elif not is_planned(fit.cylinder.radius, fit.radius_sigma, self._boq) and _contradict(candidate, fit):
                measured = Measured(candidate, *_by_the_cloud(candidate, fit))
            else:
                measured = Measured(candidate, fit.cylinder, fit.radius_sigma, fit.rims)
            if not is_known(measured.cylinder, [known.cylinder for known in found]):
                current[number] = measured.cylinder
                found.append(measured)
        return found

    def _stands_alone(self, cylinder: Cylinder, others: Sequence[Cylinder]) -> bool:
        """Whether the keyframes alone make a pipe of it: no stub, and no edge of a board or a step for one outline."""
        if is_stub(cylinder):
            return False
        return outline_support(cylinder, self._views, others).weaker_share >= MIN_SUPPORT

    def _as_planned(self, fit: ContourFit | None, others: Sequence[Cylinder]) -> ContourFit | None:
        """The fit, or one of a planned size near it whose outlines are about as well supported.

        A shadow along a pipe passes for its outline where the cameras never rise or fall. Pipes of sizes that nobody
        planned are rarer than shadows, but where the planned size finds no outlines of its own the fit stands.
        """
        if fit is None or is_planned(fit.cylinder.radius, fit.radius_sigma, self._boq):
            return fit
        radius = fit.cylinder.radius
        planned = [one.outer_radius for one in self._boq.classes if abs(one.outer_radius / radius - 1.0) < NEAR_PLANNED]
        for size in planned:
            start = Start(replace(fit.cylinder, radius=size), abs(size - radius), radius_known=True, ends_known=True)
            again = refine(start, self._views, others, self._config)
            if (
                again is not None
                and is_planned(again.cylinder.radius, again.radius_sigma, self._boq)
                and again.support > AS_GOOD * fit.support
            ):
                return again
        return fit

    def _of_planned_size(self, candidate: Candidate, others: Sequence[Cylinder]) -> ContourFit | None:
        """The best seen fit of a planned size that the cloud allows, sought with that radius alone.

        Lines beside a thin pipe, such as its shadow's, pass for its outlines where its size is left open.
        """
        reach = 3.0 * max(candidate.radius_sigma, candidate.evidence.noise)
        sigma, fits = candidate.evidence.noise, []
        for one in self._boq.classes:
            if candidate.blurred and abs(one.outer_radius - candidate.cylinder.radius) < reach:
                cylinder = replace(candidate.cylinder, radius=one.outer_radius)
                start = Start(cylinder, sigma, radius_known=True, ends_known=True)
                fit = refine(start, self._views, others, self._config)
                if (
                    fit is not None
                    and fit.support > CONVINCING
                    and is_planned(fit.cylinder.radius, fit.radius_sigma, self._boq)
                ):
                    fits.append(fit)
        return max(fits, key=lambda fit: fit.support, default=None)

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
        planned_radii = [planned.outer_radius for planned in self._boq.classes]
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
            start = Start(replace(cylinder, radius=radius), sigma, ends_known=True, seen=seen)
            for _ in range(MAX_ROUNDS):
                fit = refine(start, views, others, self._config, planned_radii, follow)
                if fit is None or abs(fit.cylinder.radius / start.cylinder.radius - 1.0) < SETTLED:
                    break
                start = replace(start, cylinder=fit.cylinder.cut_like(cylinder))
            if fit is not None:
                fits.append(fit)
        best = max(fits, key=lambda fit: fit.support, default=None)
        self._memory.keep(cylinder, follow, others, views, best)
        return best


def _places(cylinder: Cylinder) -> FloatArray:
    """Points (9, 3) along the axis."""
    return cylinder.start + np.linspace(0.0, 1.0, 9)[:, None] * (cylinder.end - cylinder.start)


def _alike(one: Cylinder, other: Cylinder) -> bool:
    """Whether two candidates would be judged alike: the same place and size but for a tenth of the radius."""
    tolerance = 0.1 * other.radius
    if abs(one.radius - other.radius) > tolerance:
        return False
    same = max(np.linalg.norm(one.start - other.start), np.linalg.norm(one.end - other.end))
    turned = max(np.linalg.norm(one.start - other.end), np.linalg.norm(one.end - other.start))
    return bool(min(same, turned) < max(tolerance, 0.1 * other.length))


def _agree(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether a cloud that resolves the section has the radius of the outlines."""
    sigma = np.hypot(candidate.radius_sigma, fit.radius_sigma)
    return _resolved(candidate) and bool(abs(fit.cylinder.radius - candidate.cylinder.radius) < AGREEMENT * sigma)


def _contradict(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether the outlines give a radius that a cloud which resolves the section cannot have.

    Where the cameras never rise or fall, the edge of the light along a pipe passes for its outline.
    """
    sigma = np.linalg.norm([candidate.radius_sigma, candidate.evidence.noise, fit.radius_sigma])
    return _resolved(candidate) and bool(abs(fit.cylinder.radius - candidate.cylinder.radius) > CONTRADICTION * sigma)


def _by_the_cloud(candidate: Candidate, fit: ContourFit) -> tuple[Cylinder, float]:
    """The cloud's cylinder between the ends that the keyframes show, and the standard deviation of its radius [m]."""
    sigma = float(np.hypot(candidate.radius_sigma, candidate.evidence.noise))
    return candidate.cylinder.cut_like(fit.cylinder), sigma


def _resolved(candidate: Candidate) -> bool:
    evidence, radius = candidate.evidence, candidate.cylinder.radius
    if candidate.radius_sigma > RESOLVED_SIGMA * radius:
        return False
    return radius > ROUND_RADII * evidence.noise or (
        radius > RESOLVED_RADII * evidence.noise and evidence.arc > RESOLVED_ARC
    )
