"""Candidates in the cloud: what is known already, then what bent patches, lines or sections of planes propose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.cloud import axis_voting, local_shape
from pipeprog_detect.cloud.axis_voting import Hypothesis
from pipeprog_detect.cloud.candidate import Candidate, fit_candidate, own_points, refit, thin_pipe_start
from pipeprog_detect.cloud.collinear import elbows, join, near, spanning
from pipeprog_detect.cloud.cutting_planes import CuttingPlane, place_planes, section_hypotheses
from pipeprog_detect.cloud.octree import THREADS, Octree
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.scene_context import SceneContext

# Neighbourhoods [m] in which the bend of a pipe is seen, for radii from 1 to 2 times as large. Fine to coarse, each on
# what the ones before have not explained: a coarse patch may span two pipes of a rack, a fine one may not. The finest
# comes last, when little is left for its many sites.
_SCALES = (0.028, 0.04, 0.056, 0.08, 0.113, 0.16, 0.02)
_POINTS_PER_SCALE = 7.0
# Candidates that the images judge may be so many times as rough as pipes that the cloud alone must vouch for.
_PROPOSED = 2.0
# Pipes up to this radius [m] are sought as lines of points, in neighbourhoods several times as wide.
THICKEST_LINE = 0.02
_LINE_SCALE = 0.04

Report = Callable[[float, str], None]


@dataclass(frozen=True)
class Search:
    """Where pipes are sought, which, and who is asked.

    Attributes:
        tree: the points.
        around: what is around a pipe.
        sigma: noise of the points on pipes [m].
        radius_range: least and largest radius [m].
        planned_radii: those of the bill [m].
        config: what makes a pipe.
        verifier: the images.
        report: is told the share of the detection that is done (0..1), and what is being done.
    """

    tree: Octree
    around: SceneContext
    sigma: float
    radius_range: tuple[float, float]
    planned_radii: Sequence[float]
    config: DetectConfig
    verifier: KeyframeVerifier
    report: Report

    def candidates(
        self, fresh: NDArray[np.bool_], known: Sequence[Cylinder], planes: Sequence[CuttingPlane]
    ) -> list[Candidate]:
        """Accepted cylinders of the tree's points, none sharing points with another.

        The `known` ones are measured again, and others sought among the points (N,) that are `fresh`.
        What is around them may make a corner or a hollow of them. What is too rough for the cloud alone is put to
        the images, where there are any.
        """
        free = np.ones(len(self.tree.points), bool)
        accepted: list[Candidate] = []

        def consider(hypothesis: Hypothesis) -> None:
            candidate = fit_candidate(self.tree, free, hypothesis, self.sigma)
            if candidate is None or self.around.rejects(candidate):
                return
            if is_pipe(candidate, self.sigma, self.config) or (
                is_pipe(candidate, self.sigma, self.config, _PROPOSED) and self.verifier.verify(candidate)
            ):
                accepted.append(candidate)
                cylinder = candidate.cylinder
                reach = cylinder.radius + 3.0 * candidate.band
                free[self.tree.near_segment(cylinder.start, cylinder.end, reach)] = False

        for cylinder in known:
            consider(Hypothesis(cylinder, 0))
        if self.config.front_end == "planes":
            self.report(0.2, "looking for sections of pipes")
            planes = planes or place_planes(self.tree, self.sigma, self.radius_range)
            seed, straighten = self.config.seed, self.config.straighten
            proposed = section_hypotheses(self.tree, free, planes, self.sigma, self.radius_range, seed, straighten)
        else:
            proposed = self._voted(fresh, free)
        for hypothesis in proposed:
            consider(hypothesis)
        self.report(0.8, "measuring")
        # Where the noise hides the section only the bill tells a thin pipe from the edge of a plate.
        return [
            candidate
            for candidate in self._settled(accepted)
            if self.verifier.has_views or not candidate.blurred or self._is_planned(candidate)
        ]

    def _is_planned(self, candidate: Candidate) -> bool:
        """Whether its radius is one of the bill's, as well as it is known."""
        radius, sigma = candidate.cylinder.radius, candidate.radius_sigma
        return any(abs(radius - planned) < 4.0 * sigma for planned in self.planned_radii)

    def _voted(self, fresh: NDArray[np.bool_], free: NDArray[np.bool_]) -> Iterator[Hypothesis]:
        """Hypotheses of the fresh points that are free at that time: bent patches, fine to coarse, then lines."""
        if not fresh.any():
            return
        scales = [scale for scale in _SCALES if scale < self.radius_range[1] and 2.0 * scale > self.radius_range[0]]
        for number, scale in enumerate(scales):
            self.report(0.2 + 0.5 * number / len(scales), f"looking for pipes in patches of {1e3 * scale:.0f} mm")
            rest = self.tree.subset(free & fresh)
            fine = rest.thinned(rest.level_of(scale / _POINTS_PER_SCALE))
            shape = local_shape.surfaces(fine, rest.thinned(rest.level_of(scale)), scale, self.sigma)
            yield from axis_voting.hypotheses_of(axis_voting.patch_votes(shape, self.sigma, self.radius_range))
        self.report(0.7, "looking for thin pipes")
        thin = [planned for planned in self.planned_radii if planned < THICKEST_LINE] or [0.5 * THICKEST_LINE]
        rest = self.tree.subset(free & fresh)
        fine = rest.thinned(rest.level_of(_LINE_SCALE / _POINTS_PER_SCALE))
        shape = local_shape.surfaces(fine, rest.thinned(rest.level_of(0.5 * _LINE_SCALE)), _LINE_SCALE, self.sigma)
        for line in axis_voting.hypotheses_of(axis_voting.line_votes(shape, self.sigma, THICKEST_LINE)):
            initial = thin_pipe_start(self.tree, free, line.cylinder, 1.2 * self.sigma, thin)
            if initial is not None:
                yield Hypothesis(initial, line.votes)

    def _settled(self, accepted: list[Candidate]) -> list[Candidate]:
        """Pieces of one pipe joined, then each measured on what lies nearest to it, elbows and the unfounded left out.

        The pipe found first had its neighbour's points as well: once both are known they are told apart.
        """

        def settled(pieces: list[int], again: bool) -> Candidate | None:
            best = max(pieces, key=lambda piece: accepted[piece].points)
            cylinder = spanning([accepted[piece].cylinder for piece in pieces], best=pieces.index(best))
            band = accepted[best].band
            margin = cylinder.radius * cylinder.axis
            reach = 1.5 * cylinder.radius + 6.0 * band
            others = [accepted[k].cylinder for k in range(len(accepted)) if k not in pieces]
            others = [other for other in others if near(other, cylinder, reach)]
            if again and len(pieces) == 1 and not others:
                return accepted[best]
            rows = self.tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)
            points = own_points(self.tree.points[rows], cylinder, others)
            candidate = refit(points, cylinder, band, whole=again or len(pieces) > 1)
            if candidate is not None and is_pipe(candidate, self.sigma, self.config, _PROPOSED):
                return candidate
            # Where there are images, they will measure it.
            return replace(accepted[best], cylinder=cylinder) if self.verifier.has_views else None

        for again in (False, True):
            joined = join([candidate.cylinder for candidate in accepted])
            # Most of it is compiled, and lets other threads run.
            with ThreadPoolExecutor(THREADS) as pool:
                measured = list(pool.map(settled, joined, repeat(again)))
            accepted = [candidate for candidate in measured if candidate is not None]
        bends = elbows([candidate.cylinder for candidate in accepted])
        return [candidate for number, candidate in enumerate(accepted) if number not in bends]


def is_pipe(candidate: Candidate, sigma: float, config: DetectConfig, roughness: float = 1.0) -> bool:
    """Whether the evidence makes a pipe of a cylinder whose surface may be `roughness` times as rough as usual."""
    evidence, cylinder = candidate.evidence, candidate.cylinder
    # The smaller the arc, the more surfaces that are no pipe fit it: its length has to make up for that.
    slender = 3.0 if evidence.arc > np.radians(80.0) else 6.0
    # A thin pipe stands clear of what is behind it and shows its half; a strip of a surface does not.
    vague = candidate.radius_sigma > 0.05 * cylinder.radius or cylinder.radius < THICKEST_LINE
    return (
        cylinder.length >= max(slender * cylinder.radius, config.length_min)
        and candidate.radius_sigma < 0.15 * cylinder.radius
        and evidence.arc >= np.radians(max(config.arc_min_deg, 90.0) if vague else config.arc_min_deg)
        and evidence.coverage > 0.4
        and evidence.inside < 0.15
        and evidence.noise < roughness * (1.6 * sigma + 8e-4)
        and evidence.roundness < roughness * (0.3 * sigma + 0.02 * cylinder.radius + 3e-4)
        and evidence.flatness > 1.3
    )
