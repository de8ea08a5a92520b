# SPDX-License-Identifier: Apache-2.0
"""Candidates in the cloud: what is known already, then what bent patches, lines or sections of planes propose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.cloud import axis_voting, local_shape
from pipeprog_detect.cloud.acceptance import HALF_STEP, THICKEST_LINE, AcceptanceCriteria
from pipeprog_detect.cloud.axis_voting import Hypothesis
from pipeprog_detect.cloud.candidate import Candidate, fit_candidate, own_points, refit, thin_pipe_start
from pipeprog_detect.cloud.collinear import elbows, join, near, spanning
from pipeprog_detect.cloud.cutting_planes import CuttingPlane, place_planes, section_hypotheses
from pipeprog_detect.cloud.local_shape import Surfaces
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.scene_context import SceneContext

# Patch sizes [m] on which the bend of a pipe is seen, for radii from 1 to 2 times as large; steps of sqrt(2), so that
# each radius is met twice. From fine to coarse, each on the points that the ones before have not explained: a coarse
# patch may span two pipes of a rack, a fine one may not. The finest comes last, when few points are left for its many
# sites.
_PATCH_SCALES = (0.028, 0.04, 0.056, 0.08, 0.113, 0.16, 0.02)
# Patches hold cells of a seventh of their size, up to 150 points: more do not make the normal better, and take time.
_CELLS_PER_SCALE = 7.0
# Where there are keyframes to judge it, a candidate may be twice as rough as one that the cloud alone must vouch for.
_PROPOSED_ROUGHNESS = 2.0
# Size of the patches in which pipes are sought as lines, in radii of the thickest, so that they are longer than wide:
# where most are thinner, and where all are as thick. Half a barrel spreads by up to 0.7 r across, which is less than
# half of what it does along, h / root 3, from h = 2.45 r on.
_THIN_SCALE, _UNBENT_SCALE = 2.0, 2.5
# The bend of a pipe shows in a patch from a radius of 14.6 times the noise on (both in m). The curvature of a patch of
# size h is known to 8 times the noise over h^2 and the root of its independent points: some 20, as the noise of stereo
# is alike within a window. It counts as a bend from four standard deviations on: at h = 0.7 r those are 1 / r there.
_LEAST_BENT = 14.6
# Surfaces that are seen from twice the distance of most, or in a corner, are rougher than the cloud's noise tells: the
# noise of stereo grows with the square of the distance.
_ROUGHER = 4.0
# Pieces in line are one pipe where it explains more than this share of the points of each: most of them.
_EXPLAINED = 0.5
# What clamps, flanges and couplings hide of a pipe is shorter than this [m].
_LONGEST_FITTING = 0.1

Report = Callable[[float, str], None]


class _Taken:
    """The candidates that were accepted, and the points that are nobody's yet.

    Attributes:
        candidates: in the order in which they were accepted.
        free: which points of the tree (N,) lie near none of them; changed in place.
    """

    def __init__(self, tree: Octree) -> None:
        self._tree = tree
        self.candidates: list[Candidate] = []
        self.free = np.ones(len(tree.points), bool)

    @property
    def cylinders(self) -> list[Cylinder]:
        """Those of the candidates."""
        return [each.cylinder for each in self.candidates]

    def add(self, candidate: Candidate) -> None:
        """Takes a candidate with the points near it."""
        self.candidates.append(candidate)
        cylinder = candidate.cylinder
        reach = cylinder.radius + 3.0 * candidate.band
        self.free[self._tree.near_segment(cylinder.start, cylinder.end, reach)] = False

    def holds(self, cylinder: Cylinder) -> bool:
        """Whether the cylinder's middle lies within one that is taken, or no more than its radius before its ends."""
        middle = cylinder.middle[None]
        for known in self.cylinders:
            along = float(known.along(middle)[0])
            off = float(np.linalg.norm(known.from_axis(middle)))
            if off < known.radius and -known.radius < along < known.length + known.radius:
                return True
        return False


@dataclass(frozen=True)
class Search:
    """Where pipes are sought, which, and by what they are judged.

    Attributes:
        tree: the points.
        around: walls and free space around a candidate.
        criteria: what makes a pipe of a candidate for the cloud alone; with the noise of the points on pipes.
        radius_range: least and largest radius [m].
        planned_radii: those of the bill of quantities [m].
        config: the settings.
        verifier: the keyframes.
        report: is told the share of the detection that is done (0..1), and what is being done.
    """

    tree: Octree
    around: SceneContext
    criteria: AcceptanceCriteria
    radius_range: tuple[float, float]
    planned_radii: Sequence[float]
    config: DetectConfig
    verifier: KeyframeVerifier
    report: Report

    def candidates(
        self, fresh: NDArray[np.bool_], known: Sequence[Cylinder], planes: Sequence[CuttingPlane]
    ) -> list[Candidate]:
        """Accepted cylinders of the tree's points, none sharing points with another.

        The `known` ones are measured again, and others sought among the points (N,) that are `fresh`. A candidate that
        the scene rejects (a corner, a hollow) is dropped; one too rough for the cloud alone is put to the keyframes.
        One that they refuse is put to them again once its neighbours are known, which may hide a side of it. Last come
        hypotheses to which no fit with a free radius led, at the planned radii near them, planned pipes whose bend
        the noise hides, and those whose points are rougher than the others'.
        """
        taken = _Taken(self.tree)
        refused: list[Candidate] = []
        without_fit: list[Hypothesis] = []
        sections = self.config.front_end == "planes"
        proposed = self._sections(taken.free, planes) if sections else self._voted(fresh, taken.free)
        again = [Hypothesis(cylinder, 0) for cylinder in known]
        for hypothesis in chain(again, proposed):
            candidate = fit_candidate(self.tree, taken.free, hypothesis, self.criteria.noise)
            if candidate is None:
                without_fit.append(hypothesis)
            elif self._accepts(candidate):
                taken.add(candidate)
            else:
                refused.append(candidate)
        if self.verifier.has_views:
            for candidate in refused:
                if self._accepts_beside(candidate, taken):
                    taken.add(candidate)
            without_fit.sort(key=lambda each: -each.votes)
            self._hold(self._at_planned_radii(without_fit), taken)
            if not sections:
                self._hold(self._unbent(fresh, taken.free), taken)
                self.report(0.75, "looking for pipes in rougher surfaces")
                criteria = replace(self.criteria, noise=_ROUGHER * self.criteria.noise)
                rough = replace(self, criteria=criteria, report=lambda _share, _what: None)
                rough._hold(self._at_planned_radii(chain(again, rough._bent(fresh, taken.free))), taken)
        self.report(0.8, "measuring")
        # Where the noise hides the section only the planned radii tell a thin pipe from the edge of a plate.
        return [
            candidate
            for candidate in self._refitted(taken.candidates)
            if self.verifier.has_views or not candidate.blurred or self._is_planned(candidate)
        ]

    def _hold(self, hypotheses: Iterable[Hypothesis], taken: _Taken) -> None:
        """Take those that the keyframes verify beside what is taken, fitted at the radii of the hypotheses."""
        for hypothesis in hypotheses:
            if not taken.holds(hypothesis.cylinder):
                held = fit_candidate(self.tree, taken.free, hypothesis, self.criteria.noise, hold_radius=True)
                if held is not None and self._accepts_beside(held, taken):
                    taken.add(held)

    def _accepts(self, candidate: Candidate) -> bool:
        if self.around.rejects(candidate):
            return False
        if self.criteria.accept(candidate):
            return True
        proposed = self.criteria.relaxed(_PROPOSED_ROUGHNESS)
        if proposed.accept(candidate):
            return self.verifier.verify(candidate)
        least = proposed.slenderness * candidate.cylinder.radius
        is_piece = proposed.of_piece().accept(candidate) or proposed.of_short_piece().accept(candidate)
        return is_piece and self.verifier.verify(candidate, least)

    def _accepts_beside(self, candidate: Candidate, taken: _Taken) -> bool:
        """Whether what is taken leaves enough of a candidate visible that the keyframes make a pipe of it.

        One whose bend the noise hides must be visible on both sides.
        """
        proposed = self.criteria.relaxed(_PROPOSED_ROUGHNESS)
        if (
            not (proposed.of_held_radius() if candidate.radius_held else proposed).accept(candidate)
            or taken.holds(candidate.cylinder)
            or self.around.rejects(candidate)
        ):
            return False
        if candidate.radius_held and self._is_unbent(candidate.cylinder.radius):
            return self.verifier.verify(candidate)
        return self.verifier.verify_beside(candidate, taken.cylinders)

    def _is_unbent(self, radius: float) -> bool:
        """Whether the noise may hide the bend of pipes of this radius [m]; thinner ones are always sought as lines."""
        return THICKEST_LINE < radius < _LEAST_BENT * _PROPOSED_ROUGHNESS * self.criteria.noise

    def _at_planned_radii(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Each hypothesis at the planned radii within half a step between sizes of its own, the nearest one first."""
        for hypothesis in hypotheses:
            cylinder = hypothesis.cylinder
            near = [each for each in self.planned_radii if abs(each / cylinder.radius - 1.0) < HALF_STEP]
            for radius in sorted(near, key=lambda each: abs(each - cylinder.radius)):
                if radius > THICKEST_LINE:
                    yield replace(hypothesis, cylinder=replace(cylinder, radius=radius))

    def _is_planned(self, candidate: Candidate) -> bool:
        """Whether its radius is within four standard deviations of a planned one."""
        radius, sigma = candidate.cylinder.radius, candidate.radius_sigma
        return any(abs(radius - planned) < 4.0 * sigma for planned in self.planned_radii)

    def _sections(self, free: NDArray[np.bool_], planes: Sequence[CuttingPlane]) -> Iterator[Hypothesis]:
        """Hypotheses of the points that are free at that time: sections of the given planes, or of planes placed."""
        self.report(0.2, "looking for sections of pipes")
        sigma, radius_range = self.criteria.noise, self.radius_range
        planes = planes or place_planes(self.tree, sigma, radius_range)
        seed, straighten = self.config.seed, self.config.straighten
        yield from section_hypotheses(self.tree, free, planes, sigma, radius_range, seed, straighten)

    def _voted(self, fresh: NDArray[np.bool_], free: NDArray[np.bool_]) -> Iterator[Hypothesis]:
        """Hypotheses of the fresh points that are free at that time: bent patches, fine to coarse, then lines."""
        if not fresh.any():
            return
        yield from self._bent(fresh, free)
        self.report(0.7, "looking for thin pipes")
        thin = [planned for planned in self.planned_radii if planned < THICKEST_LINE] or [0.5 * THICKEST_LINE]
        yield from self._lines(fresh, free, THICKEST_LINE, _THIN_SCALE, thin)

    def _bent(self, fresh: NDArray[np.bool_], free: NDArray[np.bool_]) -> Iterator[Hypothesis]:
        """Hypotheses of bent patches, fine to coarse, of the fresh points that are free then."""
        noise, (least, most) = self.criteria.noise, self.radius_range
        scales = [scale for scale in _PATCH_SCALES if scale < most and 2.0 * scale > least]
        for number, scale in enumerate(scales):
            self.report(0.2 + 0.5 * number / len(scales), f"looking for pipes in patches of {1e3 * scale:.0f} mm")
            patches = self._patches(free & fresh, scale, scale)
            yield from axis_voting.hypotheses_of(axis_voting.patch_votes(patches, noise, self.radius_range))

    def _unbent(self, fresh: NDArray[np.bool_], free: NDArray[np.bool_]) -> Iterator[Hypothesis]:
        """Hypotheses at the planned radii whose bend the noise hides, of the fresh points that are free then."""
        planned = {each for each in self.planned_radii if self._is_unbent(each)}
        for radius in sorted(planned, reverse=True):
            for line in self._lines(fresh, free, radius, _UNBENT_SCALE, [radius]):
                yield replace(line, cylinder=replace(line.cylinder, radius=radius))

    def _lines(
        self, fresh: NDArray[np.bool_], free: NDArray[np.bool_], thickest: float, scale: float, radii: Sequence[float]
    ) -> Iterator[Hypothesis]:
        """Hypotheses, started at one of the radii, along lines of points of radius `thickest` [m] at most.

        scale: of the patches that show a line, in `thickest`.
        """
        noise = self.criteria.noise
        patches = self._patches(free & fresh, scale * thickest, thickest)
        for line in axis_voting.hypotheses_of(axis_voting.line_votes(patches, noise, thickest)):
            initial = thin_pipe_start(self.tree, free, line.cylinder, 1.2 * noise, radii)
            if initial is not None:
                yield Hypothesis(initial, line.votes)

    def _patches(self, chosen: NDArray[np.bool_], scale: float, spacing: float) -> Surfaces:
        """Shape of the chosen points (N,) within `scale` [m] of sites that are `spacing` [m] apart."""
        rest = self.tree.subset(chosen)
        fine = rest.thinned(rest.level_of(scale / _CELLS_PER_SCALE))
        return local_shape.surfaces(fine, rest.thinned(rest.level_of(spacing)), scale, self.criteria.noise)

    def _refitted(self, accepted: list[Candidate]) -> list[Candidate]:
        """Pieces of one pipe joined and each refitted to the points nearest to it; elbows are left out.

        The pipe found first had its neighbour's points as well: once both are known they are told apart, in two rounds.
        """
        for again in (False, True):
            joined = join([candidate.cylinder for candidate in accepted])
            accepted = list(chain.from_iterable(mapped(partial(self._of_pieces, accepted, again), joined)))
        bends = elbows([candidate.cylinder for candidate in accepted])
        return [candidate for number, candidate in enumerate(accepted) if number not in bends]

    def _of_pieces(self, accepted: Sequence[Candidate], again: bool, pieces: Sequence[int]) -> list[Candidate]:
        """The candidate of collinear `pieces`, or one of each piece where a single pipe does not explain the points.

        Where there are keyframes, those that tell by themselves whether they are one pipe are left to them.
        """
        if self.verifier.has_views:
            apart = _told_apart([accepted[piece].cylinder for piece in pieces])
            if len(apart) > 1:
                parts = [[pieces[number] for number in part] for part in apart]
                return list(chain.from_iterable(self._of_pieces(accepted, again, part) for part in parts))
        whole = self._refit(accepted, again, pieces)
        if len(pieces) > 1 and (whole is None or not all(self._explains(whole, accepted[piece]) for piece in pieces)):
            alone = (self._refit(accepted, again, [piece]) for piece in pieces)
            return [candidate for candidate in alone if candidate is not None]
        return [] if whole is None else [whole]

    def _explains(self, whole: Candidate, piece: Candidate) -> bool:
        """Whether most of the points on a piece's surface lie on that of the `whole`, whatever lies beside them."""
        cylinder, reach = piece.cylinder, 3.0 * piece.band
        points = self.tree.points[self.tree.near_segment(cylinder.start, cylinder.end, cylinder.radius + reach)]
        surface = points[np.abs(cylinder.surface_distance(points)) < reach]
        explained = np.abs(whole.cylinder.surface_distance(surface)) < 3.0 * whole.band
        return bool(explained.sum() > _EXPLAINED * len(surface))

    def _refit(self, accepted: Sequence[Candidate], again: bool, pieces: Sequence[int]) -> Candidate | None:
        """One candidate of the `pieces` of one pipe, None where the cloud makes no pipe of it and no keyframe may."""
        best = max(pieces, key=lambda piece: accepted[piece].points)
        cylinder = spanning([accepted[piece].cylinder for piece in pieces], best=pieces.index(best))
        band = accepted[best].band
        margin = cylinder.radius * cylinder.axis
        reach = 1.5 * cylinder.radius + 6.0 * band
        others = [accepted[k].cylinder for k in range(len(accepted)) if k not in pieces]
        others = [other for other in others if near(other, cylinder, reach)]
        if again and len(pieces) == 1 and not others:
            return accepted[best]
        if accepted[best].radius_held:
            return replace(accepted[best], cylinder=cylinder)
        rows = self.tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)
        points = own_points(self.tree.points[rows], cylinder, others)
        candidate = refit(points, cylinder, band, whole=again or len(pieces) > 1)
        if candidate is not None and self.criteria.relaxed(_PROPOSED_ROUGHNESS).accept(candidate):
            return candidate
        # Where there are keyframes, they will measure it.
        return replace(accepted[best], cylinder=cylinder) if self.verifier.has_views else None


def _told_apart(pieces: Sequence[Cylinder]) -> list[list[int]]:
    """The numbers of collinear pieces, parted at each gap that is no fitting's and shorter than what is on either side.

    An axis is extrapolated over half of such a gap with hardly more than its own error.
    """
    axis = pieces[0].axis
    ends = np.sort([[float(each.start @ axis), float(each.end @ axis)] for each in pieces], axis=1)
    runs: list[list[int]] = []
    for number in np.argsort(ends[:, 0]).tolist():
        if runs and ends[number, 0] - ends[runs[-1], 1].max() < _LONGEST_FITTING:
            runs[-1].append(number)
        else:
            runs.append([number])
    parts = runs[:1]
    for run in runs[1:]:
        before, after = ends[parts[-1]], ends[run]
        if after.min() - before.max() < min(np.ptp(before), np.ptp(after)):
            parts.append(run)
        else:
            parts[-1].extend(run)
    return parts
