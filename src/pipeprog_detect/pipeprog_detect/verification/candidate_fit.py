# SPDX-License-Identifier: Apache-2.0
"""A candidate's contour fits: from the cloud's cylinder, and with the radii that the bill of quantities plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import is_planned
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.refinement.one_sided import SeenArc, with_radius
from pipeprog_detect.silhouette.free_space import is_empty_beside
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measurement_cache import MeasurementCache, Question
from pipeprog_detect.verification.radius_agreement import allows, is_resolved

# Support that makes a pipe: those that exist show edges along more than half of their visible contour.
CONVINCING = 0.5
# The windows in which edges are sought follow from the radius: where it changes by more than this share they are placed
# anew, twice at most.
SETTLED, MAX_ROUNDS = 0.1, 3
# A planned radius within this share of one that is not planned is tried, and taken with this share of its support.
NEAR_PLANNED, AS_GOOD = 0.15, 0.6
# Planned radii are within reach of a candidate up to this many standard deviations, and of a fit, which adds the
# tolerance of manufacture (1 %, EN 10255).
REACH, MANUFACTURE = 3.0, 0.01
# Logarithm of the odds from which evidence for one of two planned radii is called strong (Jeffreys: ten to one).
STRONG = float(np.log(10.0))
# A radius with a larger standard deviation than this share of it is not told by what is seen, since sizes of pipes are
# a tenth apart at the least (DN200 and DN225).
TOLD = 0.03


@dataclass(frozen=True)
class CandidateFitter:
    """Fits candidates to their contours in the keyframes; `boq` has the planned radii, `cache` the last map's fits."""

    boq: BillOfQuantities
    cache: MeasurementCache

    def is_planned(self, fit: ContourFit) -> bool:
        """Whether the fit has a radius of the bill of quantities, within its standard deviation."""
        return is_planned(fit.cylinder.radius, fit.radius_sigma, self.boq)

    def has_planned_size(self, fit: ContourFit) -> bool:
        """Whether the fit has a radius of the bill of quantities, to the tolerance of manufacture."""
        return any(_has_size(fit, planned) for planned in self._radii())

    def is_planned_in_cloud(self, candidate: Candidate) -> bool:
        """Whether the cloud resolves the candidate's section and has a radius of the bill of quantities."""
        return is_resolved(candidate) and is_planned(candidate.cylinder.radius, _sigma(candidate), self.boq)

    def fit(
        self,
        candidate: Candidate,
        others: Sequence[Cylinder],
        views: Sequence[View],
        follow: bool = True,
        trusted: bool = False,
    ) -> ContourFit | None:
        """The most probable fit from where the cloud has the candidate; None where the views show too little.

        Args:
            candidate: of the cloud.
            others: further cylinders, which may hide it.
            views: the keyframes.
            follow: whether its ends are sought.
            trusted: whether the cloud's surface may take the place of a side that others hide.
        """
        if not views:
            return None
        question = Question.of(candidate.cylinder, follow, others, views)
        known, best = self.cache.recall(question)
        if known:
            return best
        fits = [_settled(start, views, others, self._radii(), follow) for start in self._starts(candidate, trusted)]
        best = max((fit for fit in fits if fit is not None), key=lambda fit: fit.log_odds, default=None)
        self.cache.keep(question, best)
        return best

    def near_planned(
        self, candidate: Candidate, fit: ContourFit | None, others: Sequence[Cylinder], views: Sequence[View]
    ) -> ContourFit | None:
        """The fit of a candidate, or one of a planned radius near it whose contour is about as well supported.

        A shadow along a pipe is taken for its contour where the cameras never rise or fall. Pipes of sizes that nobody
        planned are rarer than shadows, but where the planned size finds no contour of its own the fit stands. The one
        side that is seen of a pipe does not tell its radius either. Of the radii that the cloud allows those are tried
        first that agree best with the fit and the cloud together.
        """
        if fit is None or (self.has_planned_size(fit) and fit.radius_sigma < TOLD * fit.cylinder.radius):
            return fit
        radius = fit.cylinder.radius
        told = np.array([radius, candidate.cylinder.radius])
        sigmas = np.array([fit.radius_sigma, _sigma(candidate)])

        def misfit(planned: float) -> float:
            return float((((told - planned) / np.hypot(sigmas, MANUFACTURE * planned)) ** 2).sum())

        for planned in sorted(self._radii(), key=misfit):
            is_near = abs(planned / radius - 1.0) < NEAR_PLANNED
            if is_near and allows(candidate, planned, MANUFACTURE * planned):
                again = _at_radius(fit.cylinder, planned, abs(planned - radius), views, others)
                if again is None:
                    at_fit = replace(candidate, cylinder=fit.cylinder)
                    again = _of_one_side(at_fit, _with_surface(at_fit, planned, views, others), views, others)
                if again is not None and self.is_planned(again) and again.support > AS_GOOD * fit.support:
                    return again
        return fit

    def of_planned_radius(
        self,
        candidate: Candidate,
        others: Sequence[Cylinder],
        views: Sequence[View],
        least_support: float = CONVINCING,
    ) -> ContourFit | None:
        """The most probable fit of a planned radius that the cloud of a candidate allows; None without one.

        Lines beside a thin pipe, such as its shadow's, are taken for its contour where its radius is left open. A fit
        that they have led three standard deviations away from the planned radius is one of theirs, and so is one that
        the views see through beside a limb.
        """
        noise, cylinder = candidate.evidence.noise, candidate.cylinder
        near = self._within_reach(candidate)
        fits = [(planned, _at_radius(cylinder, planned, noise, views, others)) for planned in near]
        good = [
            fit
            for planned, fit in fits
            if fit is not None
            and fit.support > least_support
            and self.is_planned(fit)
            and _has_size(fit, planned)
            and not is_empty_beside(fit.cylinder, views, others)
        ]
        return max(good, key=lambda fit: fit.log_odds, default=None)

    def of_visible_side(
        self, candidate: Candidate, others: Sequence[Cylinder], views: Sequence[View]
    ) -> ContourFit | None:
        """The fit of a candidate of which others hide one side in all views, with the planned radius that it shows.

        None where the cloud allows none, or where the keyframes do not tell it from the next planned one. The surface
        that the cloud shows and the side that is seen tell the radius together; one that was given to the candidate is
        no observation, and what they tell where it is left free takes its place.
        Stereo makes an arc too flat, never too narrow: a thinner planned radius may be farther from the cloud's.
        Where the cloud resolves the section any support that makes a fit suffices. Where it does not, or the radius
        was given to it, more than half of the contour must be supported, where the surface allows it; a radius of which
        less is still is a rival of others.
        """
        told_by_cloud = is_resolved(candidate) and not candidate.radius_held
        if candidate.radius_held:
            start = Start(candidate.cylinder, _sigma(candidate), ends_known=True, seen=_seen_arc(candidate))
            free = refine(start, views, others)
            if free is None:
                return None
            sigma = float(np.hypot(free.radius_sigma, MANUFACTURE * free.cylinder.radius))
            candidate = replace(candidate, cylinder=free.cylinder, radius_sigma=sigma)
        radius, sigma = candidate.cylinder.radius, candidate.arc_sigma
        ranked = []
        for planned in self._radii():
            misfit = (planned - radius) / sigma
            if abs(misfit) < REACH and planned / radius - 1.0 < NEAR_PLANNED:
                surface = _with_surface(candidate, planned, views, others)
                fit = _of_one_side(candidate, surface, views, others)
                if fit is not None:
                    aside = float(np.linalg.norm(surface.from_axis(fit.cylinder.middle[None])))
                    moved = aside * np.sin(_seen_arc(candidate).half) / _sigma(candidate)
                    stands = told_by_cloud or (moved < REACH and fit.support > CONVINCING)
                    ranked.append((fit.log_odds - 0.5 * (misfit**2 + moved**2), stands, fit))
        ranked.sort(key=lambda entry: -entry[0])
        if not ranked or (len(ranked) > 1 and ranked[0][0] - ranked[1][0] < STRONG):
            return None
        _, stands, best = ranked[0]
        return best if stands else None

    def strays(self, candidate: Candidate, fit: ContourFit) -> bool:
        """Whether the fit has a radius out of reach of the candidate's: it follows the edges of other things."""
        sigma = float(np.hypot(_sigma(candidate), fit.radius_sigma))
        return abs(fit.cylinder.radius - candidate.cylinder.radius) > REACH * sigma

    def _within_reach(self, candidate: Candidate) -> list[float]:
        """The planned radii [m] that the cloud of a candidate allows."""
        reach = REACH * _sigma(candidate)
        return [planned for planned in self._radii() if abs(planned - candidate.cylinder.radius) < reach]

    def _radii(self) -> list[float]:
        return list(self.boq.radii)

    def _starts(self, candidate: Candidate, trusted: bool) -> list[Start]:
        """Where the contour is sought: at the candidate's radius, and at planned ones if the cloud leaves it open."""
        sigma, cylinder = _sigma(candidate), candidate.cylinder
        seen = SeenArc(candidate.evidence.arc, sigma) if trusted and not candidate.blurred else None
        planned = self._within_reach(candidate) if candidate.blurred or candidate.radius_held else []
        radii = dict.fromkeys([cylinder.radius, *planned])  # a radius that is held is a planned one
        return [Start(replace(cylinder, radius=radius), sigma, ends_known=True, seen=seen) for radius in radii]


def _settled(
    start: Start, views: Sequence[View], others: Sequence[Cylinder], radii: Sequence[float], follow: bool
) -> ContourFit | None:
    """The fit of a start, from windows that are those of its own radius."""
    given = start.cylinder
    fit = None
    for _ in range(MAX_ROUNDS):
        fit = refine(start, views, others, radii, follow)
        if fit is None or abs(fit.cylinder.radius / start.cylinder.radius - 1.0) < SETTLED:
            break
        start = replace(start, cylinder=fit.cylinder.cut_like(given))
    return fit


def _at_radius(
    cylinder: Cylinder, radius: float, radius_sigma: float, views: Sequence[View], others: Sequence[Cylinder]
) -> ContourFit | None:
    """The fit of a cylinder with another radius, which is taken as known."""
    start = Start(replace(cylinder, radius=radius), radius_sigma, radius_known=True, ends_known=True)
    return refine(start, views, others)


def _of_one_side(
    candidate: Candidate, known: Cylinder, views: Sequence[View], others: Sequence[Cylinder]
) -> ContourFit | None:
    """The fit of a candidate of which one side is seen, at the radius of `known`, which this side cannot tell."""
    start = Start(known, _sigma(candidate), True, ends_known=True, seen=_seen_arc(candidate), radius_fixed=True)
    return refine(start, views, others)


def _with_surface(candidate: Candidate, radius: float, views: Sequence[View], others: Sequence[Cylinder]) -> Cylinder:
    """A candidate with another radius and the surface that the cloud shows."""
    return with_radius(Scene.of(candidate.cylinder, views, others), _seen_arc(candidate), radius)


def _seen_arc(candidate: Candidate) -> SeenArc:
    return SeenArc(candidate.evidence.arc, _sigma(candidate))


def _sigma(candidate: Candidate) -> float:
    """Standard deviation of the surface [m]: it may lie as far from its points' mean as these scatter."""
    return max(candidate.radius_sigma, candidate.evidence.noise)


def _has_size(fit: ContourFit, planned: float) -> bool:
    """Whether a fit has the planned radius [m], within its standard deviation and the tolerance of manufacture."""
    return abs(fit.cylinder.radius - planned) < REACH * fit.radius_sigma + MANUFACTURE * planned
