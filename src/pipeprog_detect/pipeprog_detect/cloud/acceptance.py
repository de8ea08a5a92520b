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
# Half a step between two standard sizes, in r: from DN 15 to DN 200 the diameters of EN 10220 series 1 (21.3 to
# 219.1 mm) rise in 11 steps, of 24 % in the geometric mean; half of ln 1.24.
HALF_STEP = 0.1076
# A piece that is as long as it is wide, in r, tells the axis as well as the radius.
_PIECE = 2.0
# One of half that length, in r, does so where its radius, and with it its axis, is known to this share of the radius:
# over the three radii that the keyframes must show the axis is then known to a fortieth (from ends that are known to a
# hundredth, a length beyond either: root 5 times as much).
_SHORT_PIECE, _SURELY_KNOWN = 1.0, 0.01
# With a greater standard deviation of the radius, in r, it lies by more than half a step from the true one for half of
# the pipes, and the nearest standard size is most often a wrong one (0.75 quantile of the normal distribution: 0.674).
VAGUEST = HALF_STEP / 0.674


@dataclass(frozen=True)
class AcceptanceCriteria:
    """Thresholds on a candidate of radius r, from a cloud whose points scatter by `noise` across pipes.

    Attributes:
        noise: standard deviation of the cloud's points across the surfaces of pipes [m].
        length_min: least length [m].
        arc_min: least part of the circumference seen [rad].
        slenderness: least length, in r. An elbow fits a short cylinder: that of EN 10253-2, type 3D, measures 3 r from
            its end to the middle of the turn.
        slenderness_small_arc: the same for arcs up to 80 deg. The back of such an elbow is a strip about a circle of
            4 r: from end to end it measures root 2 times 4 r.
        radius_sigma_max: greatest standard deviation of the radius, in r.
        vague_radius_sigma: standard deviation of the radius, in r, from which on (as for all pipes up to THICKEST_LINE)
            a quarter of the circumference must be seen: the next size comes out in 1 % of the cases (0.99 quantile:
            2.33).
        coverage_min: least share of the length that shows surface: occluders may hide more than half of a pipe. No
            model of them gives the value: it was set on generated sites (docs/accuracy.md has the result).
        intrusion_max: most points within the barrel, in points on its surface: a barrel is opaque, but stereo leaves
            stray points. What share of them depends on the camera and the surfaces: set on generated sites, too.
        noise_slope, noise_floor: the points' root mean square distance from the surface stays below noise_slope x noise
            + noise_floor [m]. The noise is a median over surfaces at all angles; head-on it is root 2 times that, and
            clouds are wavy by about 1 mm. The values were set on generated sites. (Derived, 1.33 x hypot(root 2 x
            noise, 1 mm), with the roundness below, gave one false pipe more on the recording field_b.)
        noise_max: greatest such distance, in r.
        roundness_slope, roundness_share, roundness_floor: the section's root mean square deviation from the circle
            stays below roundness_slope x noise + roundness_share x r + roundness_floor [m]. Steel pipes may deviate by
            1 % of r and by 0.25 mm; the rest, for noise and waviness, was set on generated sites. (Derived from
            tolerance, waviness and the standard error of 36 sectors, it is wider for thin lines: see noise_slope.)
        flatness_min: least ratio of the mean squares of the distances from the best plane and from the cylinder. A
            cylinder has 5 unknowns, 2 more than a plane: by an F test on the 30 points of the least candidate 1 % of
            planes give a greater ratio (0.99 quantile of F for 2 and 25 degrees of freedom: 5.57; 1 + 2 / 25 x 5.57).
        roughness: factor on the limits of noise and roundness.
        held_radius: whether the radius may be one that was given to the fit.
    """

    noise: float
    length_min: float
    arc_min: float
    slenderness: float = 3.0
    slenderness_small_arc: float = 5.66
    radius_sigma_max: float = VAGUEST
    vague_radius_sigma: float = HALF_STEP / 2.33
    vague_radius: float = THICKEST_LINE
    coverage_min: float = 0.4
    intrusion_max: float = 0.15
    noise_slope: float = 1.6
    noise_floor: float = 8e-4
    noise_max: float = np.inf
    roundness_slope: float = 0.3
    roundness_share: float = 0.02
    roundness_floor: float = 3e-4
    flatness_min: float = 1.45
    roughness: float = 1.0
    held_radius: bool = False

    def relaxed(self, roughness: float) -> AcceptanceCriteria:
        """The criteria for surfaces that may be `roughness` times as rough."""
        return replace(self, roughness=roughness)

    def of_piece(self) -> AcceptanceCriteria:
        """The criteria for a piece of a pipe of which the cloud shows no more: as long as it is wide.

        The keyframes, which must verify it, tell it from the back of an elbow.
        """
        return replace(self, slenderness=_PIECE, slenderness_small_arc=_PIECE)

    def of_short_piece(self) -> AcceptanceCriteria:
        """The criteria for an even shorter piece, whose radius must be known the better."""
        return replace(self, slenderness=_SHORT_PIECE, radius_sigma_max=_SURELY_KNOWN)

    def of_held_radius(self) -> AcceptanceCriteria:
        """The criteria where the radius was given, which leaves it open: the points fit it better than a plane."""
        return replace(self, held_radius=True, radius_sigma_max=np.inf, vague_radius_sigma=np.inf, flatness_min=1.0)

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
            (self.held_radius or not candidate.radius_held)
            and candidate.cylinder.length >= max(slenderness * radius, self.length_min)
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
