# SPDX-License-Identifier: Apache-2.0
"""What makes a pipe of a candidate: one set of thresholds for pipes seen from outside, one for pipes from inside."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.config import DetectConfig

# Pipes up to this radius [m] show no bend in a cloud of millimetres of noise and are sought as lines of points.
THICKEST_LINE = 0.02
# A candidate counts the seen part of its circumference in sectors of 5 deg: thresholds lie halfway between two counts.
_HALF_SECTOR = 2.5


@dataclass(frozen=True)
class AcceptanceCriteria:
    """Thresholds on a candidate of radius r, from a cloud whose points scatter by `noise` across pipes.

    The limits of noise and roundness are sums of a multiple of the noise, a share of the radius and a constant. The
    other limits are ratios. Where no reason is given, the value was set on generated sites (docs/accuracy.md says with
    which result) and follows from nothing else.

    Attributes:
        noise: standard deviation of the cloud's points across the surfaces of pipes [m].
        length_min: least length [m].
        arc_min: least part of the circumference seen [rad].
        slenderness: least length, in r.
        slenderness_small_arc: the same for arcs up to 80 deg: a strip that is bent so little is also found on other
            things, but seldom a long one.
        radius_sigma_max: greatest standard deviation of the radius, in r. Standard sizes follow each other by steps of
            about 25 %: with more than 15 % the cloud does not tell two neighbouring sizes apart even at one sigma.
        vague_radius_sigma: standard deviation of the radius, in r, from which on (as for all pipes up to THICKEST_LINE)
            a quarter of the circumference must be seen: a strip of a surface shows less.
        coverage_min: least share of the length that shows surface.
        intrusion_max: most points within the barrel, in points on its surface: a barrel is opaque, but stereo leaves
            stray points.
        noise_slope, noise_floor: the points' spread across the surface stays below noise_slope x noise + noise_floor
            [m]. The noise is a median over surfaces at all angles; head-on it is greater, and clouds are wavy.
        noise_max: greatest spread of the points, in r.
        roundness_slope, roundness_share, roundness_floor: the section's root mean square deviation from the circle
            stays below roundness_slope x noise + roundness_share x r + roundness_floor [m]. The share is twice the
            1 % of the diameter that EN 10220 allows pipes to differ by.
        flatness_min: least ratio of the mean squares of the distances from the best plane and from the cylinder: at 1
            a plane explains the points as well.
        roughness: factor on the limits of noise and roundness.
    """

    noise: float
    length_min: float
    arc_min: float
    slenderness: float = 3.0
    slenderness_small_arc: float = 6.0
    radius_sigma_max: float = 0.15
    vague_radius_sigma: float = 0.05
    vague_radius: float = THICKEST_LINE
    coverage_min: float = 0.4
    intrusion_max: float = 0.15
    noise_slope: float = 1.6
    noise_floor: float = 8e-4
    noise_max: float = np.inf
    roundness_slope: float = 0.3
    roundness_share: float = 0.02
    roundness_floor: float = 3e-4
    flatness_min: float = 1.3
    roughness: float = 1.0

    def relaxed(self, roughness: float) -> AcceptanceCriteria:
        """The criteria for surfaces that may be `roughness` times as rough."""
        return replace(self, roughness=roughness)

    def accept(self, candidate: Candidate) -> bool:
        """Whether the evidence of the cloud makes a pipe of the candidate."""
        evidence, radius = candidate.evidence, candidate.cylinder.radius
        small_arc = evidence.arc < np.radians(80.0 + _HALF_SECTOR)
        slenderness = self.slenderness_small_arc if small_arc else self.slenderness
        vague = candidate.radius_sigma > self.vague_radius_sigma * radius or radius < self.vague_radius
        arc_min = max(self.arc_min, np.radians(90.0 - _HALF_SECTOR)) if vague else self.arc_min
        noise_max = self.roughness * (self.noise_slope * self.noise + self.noise_floor)
        roundness_max = self.roundness_slope * self.noise + self.roundness_share * radius + self.roundness_floor
        return (
            candidate.cylinder.length >= max(slenderness * radius, self.length_min)
            and candidate.radius_sigma < self.radius_sigma_max * radius
            and evidence.arc >= arc_min
            and evidence.coverage > self.coverage_min
            and evidence.inside < self.intrusion_max
            and evidence.noise < min(noise_max, self.noise_max * radius)
            and evidence.roundness < self.roughness * roundness_max
            and evidence.flatness > self.flatness_min
        )


def seen_from_outside(noise: float, config: DetectConfig) -> AcceptanceCriteria:
    """The criteria for pipes in a room; noise [m] of the points on pipes."""
    return AcceptanceCriteria(noise, config.length_min, float(np.radians(config.arc_min_deg)))


def seen_from_inside(noise: float, config: DetectConfig) -> AcceptanceCriteria:
    """The criteria for the pipe that a camera is in; noise [m] of the cloud.

    Depth cameras are several times as rough at the far end of a pipe as at the near one, so the surface may be twice
    as rough; but the camera is a few radii away from what it sees best, and a depth camera's noise is a hundredth of
    that distance: 5 % of the radius at most. The axis runs along the view, so a piece may be as short as half a radius;
    the radius must then be the better known, to 2 %. Less than 75 deg of arc is as well a bent piece of something else.
    """
    return AcceptanceCriteria(
        noise,
        config.length_min,
        float(np.radians(max(75.0 - _HALF_SECTOR, config.arc_min_deg))),
        slenderness=0.5,
        slenderness_small_arc=0.5,
        radius_sigma_max=0.02,
        vague_radius_sigma=np.inf,
        vague_radius=0.0,
        noise_max=0.05,
        flatness_min=-np.inf,
        roughness=2.0,
    )
