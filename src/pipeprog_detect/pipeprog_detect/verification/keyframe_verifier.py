# SPDX-License-Identifier: Apache-2.0
"""The cloud's candidates before the keyframes: measured by their contours, kept as the cloud has them, or dropped."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.refinement.extension import LEAST_STUB
from pipeprog_detect.refinement.one_sided import only_visible_side
from pipeprog_detect.silhouette.apparent_contour import views_showing
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.free_space import free_stretches, is_empty_beside
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.candidate_fit import CONVINCING, CandidateFitter
from pipeprog_detect.verification.measured_pipe import DECISIVE, MeasuredPipe, is_stub, lacks_a_side
from pipeprog_detect.verification.measurement_cache import MeasurementCache
from pipeprog_detect.verification.radius_agreement import agree, contradict, doubts, is_resolved

# Views of a candidate that suffice to tell it from a shadow; to measure it all are used.
FEW_VIEWS = 30
# Points along an axis by which the views that show it are found.
AXIS_POINTS = 9
# A candidate that is refused is measured once: another one within this share of its radius and length has its contour.
SAME = 0.1


class KeyframeVerifier:
    """Verifies and measures the cloud's candidates in the keyframes; without keyframes they stay as they are."""

    def __init__(self, views: Sequence[View], boq: BillOfQuantities, cache: MeasurementCache | None = None) -> None:
        self._views = views
        self._fitter = CandidateFitter(boq, cache or MeasurementCache())
        self._refused: list[tuple[Cylinder, ContourFit | None]] = []

    @property
    def has_views(self) -> bool:
        """Whether there are keyframes."""
        return bool(self._views)

    def verify(self, candidate: Candidate, least_length: float = 0.0) -> bool:
        """Whether the keyframes make a pipe of a candidate that the cloud alone does not.

        They must support more than half of its contour, which must have a planned radius: shadows have contours, too.
        Where the cloud resolves its section and has that radius as well, any support that makes a fit suffices. Where
        it does not, a glossy pipe's highlight may be taken for its contour, unless the radius is held to a planned one.

        One of which the cloud resolves the section and the keyframes show no other side is verified by the side that
        they show of it.

        `least_length` [m]: they must show it as long as that, however much of it the cloud has (a smooth white pipe
        gives stereo points at its ends alone).
        """
        if not self.has_views:
            return False
        cylinder = candidate.cylinder
        known = next((each for each in self._refused if _resembles(cylinder, each[0])), None)
        fit = self._contour(candidate) if known is None else known[1]
        stands = fit is not None and self._stands(candidate, fit)
        if stands and cylinder.length < least_length:
            whole = self._fitter.fit(candidate, [], self._few_views(cylinder))
            stands = whole is not None and whole.cylinder.length >= least_length
            fit = fit if stands else None
        if not stands and known is None:
            self._refused.append((cylinder, fit))
        return stands

    def _stands(self, candidate: Candidate, fit: ContourFit) -> bool:
        """Whether a contour makes a pipe of a candidate: see `verify`."""
        return self._fitter.is_planned(fit) and (fit.support > CONVINCING or agree(candidate, fit))

    def _few_views(self, cylinder: Cylinder) -> list[View]:
        """Keyframes that show a cylinder, as many as suffice to verify it."""
        return views_showing(cylinder.at(np.linspace(0.0, 1.0, AXIS_POINTS)), self._views, FEW_VIEWS)

    def _contour(self, candidate: Candidate) -> ContourFit | None:
        """The contour of a candidate, between the ends that it has."""
        fit = self._fitter.fit(candidate, [], self._few_views(candidate.cylinder), follow=False)
        fit = self._fitter.near_planned(candidate, fit, [], self._views)
        if candidate.blurred and (fit is None or not self._fitter.is_planned(fit)):
            fit = self._fitter.of_planned_radius(candidate, [], self._views)
        if fit is None and is_resolved(candidate):
            fit = self._fitter.of_visible_side(candidate, [], self._views)
        return fit

    def verify_beside(self, candidate: Candidate, others: Sequence[Cylinder]) -> bool:
        """Whether the keyframes make a pipe of a candidate by what the others leave visible of it.

        Its radius was held, or they hide one side of it: where both are visible, `verify` tells.
        """
        if candidate.radius_held:
            if any(_resembles(candidate.cylinder, refused) for refused, _ in self._refused):
                return False
        elif only_visible_side(Scene.of(candidate.cylinder, self._views, others)) is None:
            return False
        stands = self._fitter.of_visible_side(candidate, others, self._views) is not None
        if not stands:
            self._refused.append((candidate.cylinder, None))
        return stands

    def measure(self, candidates: Sequence[Candidate], trusted: Sequence[bool]) -> list[MeasuredPipe]:
        """The candidates that stand, measured by their contours.

        `trusted`: whether the cloud alone makes a pipe of a candidate. Those with most points come first; the cylinders
        that they turn out to be hide the others when these are measured. One that lies within another takes its place
        only where the edges are decisively its own: pipes of several radii in line may look like a thicker one in the
        cloud, and one side of a pipe like that of a thinner one.
        """
        order = sorted(range(len(candidates)), key=lambda number: -candidates[number].points)
        waiting = {number: candidates[number].cylinder for number in order if trusted[number]}
        found: list[tuple[MeasuredPipe, bool]] = []
        for number in order:
            waiting.pop(number, None)
            others = [*waiting.values(), *(known.cylinder for known, _ in found)]
            measured = self.measured(candidates[number], others, trusted[number])
            if measured is not None:
                for piece in self._pieces(measured, others, trusted[number]):
                    found = self._with(piece, trusted[number], found, list(waiting.values()))
        # What the cloud took for one may have hidden a gap before all were known.
        pipes = []
        for place, (pipe, is_trusted) in enumerate(found):
            others = [known.cylinder for known, _ in found[:place] + found[place + 1 :]]
            pipes += self._pieces(pipe, others, is_trusted)
        return pipes

    def _with(
        self,
        piece: MeasuredPipe,
        trusted: bool,
        found: Sequence[tuple[MeasuredPipe, bool]],
        waiting: Sequence[Cylinder],
    ) -> list[tuple[MeasuredPipe, bool]]:
        """The pipes found, each with whether it is trusted, and a piece that lies in none of them, or refutes them.

        What is left of one that it refutes, beyond its own ends, is measured anew: it may be a pipe in line with it.
        """
        middle = piece.cylinder.middle
        around = [each for each in found if each[0].cylinder.contains(middle)]
        if not all(_is_refuted(known, piece) for known, _ in around):
            return list(found)
        kept = [each for each in found if not each[0].cylinder.contains(middle)]
        kept.append((piece, trusted))
        for known, is_trusted in around:
            for rest in _beyond(known, piece.cylinder):
                others = [*waiting, *(other.cylinder for other, _ in kept)]
                again = self.measured(rest, others, is_trusted)
                if again is not None and not any(each.cylinder.contains(again.cylinder.middle) for each, _ in kept):
                    kept.append((again, is_trusted))
        return kept

    def _pieces(self, measured: MeasuredPipe, others: Sequence[Cylinder], trusted: bool) -> list[MeasuredPipe]:
        """The pipe itself, or what lies between the stretches at which the views see through it, measured anew.

        A part is no pipe where its contour, which was seen elsewhere, is not found, and one side shows no edges: what
        the cloud has of the whole says little of a part.
        """
        whole = measured.cylinder
        free = free_stretches(whole, self._views, others)
        if not free:
            return [measured]
        bounds = [0.0, *(end for stretch in free for end in stretch), whole.length]
        parts = [measured.part(*each) for each in zip(bounds[::2], bounds[1::2], strict=True)]
        pieces = (self.measured(part, others, trusted) for part in parts if _is_long(part.cylinder))
        return [
            piece
            for piece in pieces
            if piece is not None
            and (piece.fit or not measured.fit or not lacks_a_side(piece.cylinder, self._views, others))
        ]

    def measured(self, candidate: Candidate, others: Sequence[Cylinder], trusted: bool) -> MeasuredPipe | None:
        """The pipe that cloud and keyframes make of a candidate; None where they make none.

        A candidate whose contour is not seen stays as the cloud has it only where it is trusted and, beside keyframes
        that should have shown it, resolved by the cloud. Then it keeps its radius as well if that is planned, and that
        of a contour which is hardly seen is not. One that is not trusted, and whose contour has no planned radius, may
        show one side alone, or be too thick in the cloud for its own edges to be within the search.

        A contour of which one limb is none, or which is hardly seen, gives way to one of a planned radius that the
        cloud allows.
        """
        if not self.has_views:
            return MeasuredPipe.of_cloud(candidate) if trusted else None
        fit = self._fitter.fit(candidate, others, self._views, trusted=trusted)
        is_planned = fit is not None and self._fitter.is_planned(fit)
        if not is_planned and not trusted and (candidate.radius_held or not candidate.blurred):
            fit = self._fitter.of_visible_side(candidate, others, self._views) or fit
        if fit is None and not (trusted and is_resolved(candidate)):
            return None
        if candidate.blurred or not trusted:
            # Where noise hides the section only the planned radii tell a thin pipe from the edge of a plate; where an
            # elbow is part of it they tell a stub.
            if fit is not None and self._fitter.is_planned(fit) and self._fitter.strays(candidate, fit):
                # Where the cloud has a planned radius any support of it suffices, as in `verify`.
                least = MIN_SUPPORT if self._fitter.is_planned_in_cloud(candidate) else CONVINCING
                fit = self._fitter.of_planned_radius(candidate, others, self._views, least) or fit
            else:
                fit = self._fitter.near_planned(candidate, fit, others, self._views)
                if fit is None or not self._fitter.is_planned(fit):
                    fit = self._fitter.of_planned_radius(candidate, others, self._views)
            if fit is None or (candidate.blurred and is_stub(fit.cylinder)):
                return None
            if (candidate.blurred or candidate.radius_held) and not self._shows_both_sides(fit.cylinder, others):
                return None
        else:
            fit = self._fitter.near_planned(candidate, fit, others, self._views)
        if fit is None:
            return MeasuredPipe.of_cloud(candidate)
        if is_empty_beside(fit.cylinder, self._views, others):
            fit = self._fitter.of_planned_radius(candidate, others, self._views, MIN_SUPPORT) or fit
        elif fit.support < CONVINCING:  # the cloud may lie beside the pipe by more than a contour is sought from there
            other = self._fitter.of_planned_radius(candidate, others, self._views)
            fit = other if other is not None and other.log_odds > fit.log_odds else fit
        if self._is_misled(candidate, fit, trusted):
            return MeasuredPipe.between_ends_of(candidate, fit)
        return MeasuredPipe.of_contour(candidate, fit)

    def _is_misled(self, candidate: Candidate, fit: ContourFit, trusted: bool) -> bool:
        """Whether the cloud's radius is more probable than that of a contour, which nobody planned.

        Sizes that nobody planned are rarer than shadows along a pipe: where the cloud has a planned one, and hardly
        that of a contour of another size, the contour is that of a shadow.
        """
        is_planned = self._fitter.is_planned(fit)
        if not self._fitter.is_planned_in_cloud(candidate):
            return not is_planned and contradict(candidate, fit)
        if not self._fitter.has_planned_size(fit) and doubts(candidate, fit):
            return True
        return not is_planned and trusted and fit.support < CONVINCING

    def _shows_both_sides(self, cylinder: Cylinder, others: Sequence[Cylinder]) -> bool:
        """Whether it has edges on each side that is not hidden: a board or a step has them on one."""
        return Scene.of(cylinder, self._views, others).support().weaker_share >= MIN_SUPPORT


def _is_long(cylinder: Cylinder) -> bool:
    """Whether a part of a pipe is long enough to be measured by itself."""
    return cylinder.length > LEAST_STUB * cylinder.radius


def _beyond(known: MeasuredPipe, within: Cylinder) -> list[Candidate]:
    """The parts of a known pipe before and after the ends of a cylinder within it."""
    low, high = sorted(known.cylinder.along(np.stack([within.start, within.end])).tolist())
    parts = [known.part(*each) for each in ((0.0, low), (high, known.cylinder.length)) if each[0] < each[1]]
    return [part for part in parts if _is_long(part.cylinder)]


def _is_refuted(known: MeasuredPipe, within: MeasuredPipe) -> bool:
    """Whether the edges seen are decisively more probable on the pipe `within`, along more of it, than on the other."""
    one, other = known.fit, within.fit
    if one is None or other is None:
        return False
    return other.log_odds - one.log_odds > DECISIVE and other.log_odds > DECISIVE and other.support > one.support


def _resembles(one: Cylinder, other: Cylinder) -> bool:
    """Whether two candidates have the same position and radius to a tenth, whichever end is called the start."""
    tolerance = SAME * other.radius
    if abs(one.radius - other.radius) > tolerance:
        return False
    same = max(np.linalg.norm(one.start - other.start), np.linalg.norm(one.end - other.end))
    turned = max(np.linalg.norm(one.start - other.end), np.linalg.norm(one.end - other.start))
    return bool(min(same, turned) < max(tolerance, SAME * other.length))
