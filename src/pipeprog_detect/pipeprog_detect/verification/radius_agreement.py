# SPDX-License-Identifier: Apache-2.0
"""Whether the radius that the cloud shows and the one that the keyframes show can be those of one pipe."""

from __future__ import annotations

import numpy as np

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.refinement.contour_fit import ContourFit

# They contradict each other where they differ by more than this many standard deviations, the cloud's noise included,
# and agree where they differ by less than this many (one in twenty pipes is beyond that). Beyond this many of them (one
# in 400 pipes) one of both is more probably wrong, as a contour is along a shadow in one pipe of 60.
CONTRADICTION, AGREEMENT, DOUBT = 4.0, 2.0, 3.0
# The cloud resolves a section of five times its noise, seen along a third of the way around [rad], whose radius it
# knows to a twentieth: the edge of a box is round, too, to a cloud. Two faces lie a tenth of the radius off the circle
# along both: a section of thirty times the noise shows that, and is round wherever it is seen.
RESOLVED_RADII, RESOLVED_ARC, RESOLVED_SIGMA = 5.0, np.radians(120.0), 0.05
ROUND_RADII = 30.0


def is_resolved(candidate: Candidate) -> bool:
    """Whether the cloud alone tells the candidate's section from the edge of a box."""
    evidence, radius = candidate.evidence, candidate.cylinder.radius
    if candidate.radius_sigma > RESOLVED_SIGMA * radius:
        return False
    return radius > ROUND_RADII * evidence.noise or (
        radius > RESOLVED_RADII * evidence.noise and evidence.arc > RESOLVED_ARC
    )


def agree(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether a cloud that resolves the section has the radius of the contour.

    What stereo errs by is alike all along a pipe: the radius may be off by as much as the points scatter.
    """
    sigma = np.linalg.norm([candidate.radius_sigma, candidate.evidence.noise, fit.radius_sigma])
    difference = abs(fit.cylinder.radius - candidate.cylinder.radius)
    return is_resolved(candidate) and bool(difference < AGREEMENT * sigma)


def contradict(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether a cloud that resolves the section cannot have the radius of the contour.

    Where the cameras never rise or fall, the edge of the light along a pipe is taken for its contour.
    """
    return excludes(candidate, fit.cylinder.radius, fit.radius_sigma)


def doubts(candidate: Candidate, fit: ContourFit) -> bool:
    """Whether a cloud that resolves the section hardly has the radius of the contour."""
    return excludes(candidate, fit.cylinder.radius, fit.radius_sigma, DOUBT)


def excludes(candidate: Candidate, radius: float, radius_sigma: float, sigmas: float = CONTRADICTION) -> bool:
    """Whether a cloud that resolves the section differs by more than `sigmas` from a radius +- `radius_sigma` [m]."""
    sigma = np.linalg.norm([candidate.radius_sigma, candidate.evidence.noise, radius_sigma])
    return is_resolved(candidate) and bool(abs(radius - candidate.cylinder.radius) > sigmas * sigma)


def allows(candidate: Candidate, radius: float, radius_sigma: float) -> bool:
    """Whether a pipe of a radius [m], known to `radius_sigma` [m], may look to the cloud like the candidate.

    Stereo makes a small arc too flat, never too narrow: the pipe may be thinner.
    """
    is_flatter = candidate.evidence.arc < RESOLVED_ARC and radius < candidate.cylinder.radius
    return is_flatter or not excludes(candidate, radius, radius_sigma)
