# SPDX-License-Identifier: Apache-2.0
"""How well the keyframes tell where a pipe ends: the probability of each position of its end along the axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.axial_evidence import FARTHEST, AxialEvidence, axial_evidence
from pipeprog_detect.refinement.extension import LEAST
from pipeprog_detect.refinement.pipe_ends import (
    MOST_INSIDE,
    OUTSIDE,
    OUTSIDE_RADII,
    RIM_WORTH,
    SAMPLES_PER_PIXEL,
    all_around,
    before_bend,
    by_chance,
    pixel_at,
    rim_strength,
)
from pipeprog_detect.silhouette.apparent_contour import ViewArrays, views_showing
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

# Views that suffice: errors that views share (COMMON of the contour's evidence) leave little to the thirteenth.
ENOUGH_VIEWS = 12
# A rim is placed to half a pixel: the edges of all views share the error of the axis' place.
RIM_SIGMA = 0.5
# Positions at which the stretch beyond an end is looked for in the images.
LOOKED_AT = 9


@dataclass(frozen=True)
class EndPosterior:
    """Where a pipe ends, as far as the keyframes tell.

    Attributes:
        position: T positions [m], evenly spaced, outwards from the given end.
        probability: (T,) of the end being there.
        rim_sigma: standard deviation of a position that a rim tells [m].
        in_view: whether an image reaches beyond the end.
    """

    position: FloatArray
    probability: FloatArray
    rim_sigma: float
    in_view: bool

    @classmethod
    def of_odds(cls, position: FloatArray, odds: FloatArray, rim_sigma: float, in_view: bool) -> EndPosterior:
        """The posterior of log odds (T,), which are known up to a constant."""
        probability = np.exp(odds - odds.max())
        return cls(position, probability / probability.sum(), rim_sigma, in_view)

    def sigma(self, farthest: float = np.inf) -> float:
        """Root mean square [m] of the end's distance from the given one; what lies beyond `farthest` [m] ends there."""
        position = np.minimum(self.position, farthest)
        return float(np.hypot(np.sqrt(self.probability @ position**2), self.rim_sigma))


def end_posterior(cylinder: Cylinder, at_end: bool, views: Sequence[View], others: Sequence[Cylinder]) -> EndPosterior:
    """The probability of where a measured pipe ends, near its given end and beyond it.

    Prior: ends occur as a Poisson process with one end per measured length. The contour tells how far the pipe goes,
    to some samples; an edge all around the barrel tells it to half a pixel. Where something hides the pipe the prior is
    all there is: the end may lie anywhere in the hidden stretch, before the given end as well as beyond it, and an edge
    that is seen all around elsewhere may be a clamp's.

    Args:
        cylinder: the measured pipe.
        at_end: whether its end is asked for, or its start.
        views: the keyframes.
        others: further pipes, which may hide this one.
    """
    barrel = cylinder if at_end else Cylinder(cylinder.end, cylinder.start, cylinder.radius)
    near = max(OUTSIDE, OUTSIDE_RADII * cylinder.radius)
    inside, ahead = min(near, MOST_INSIDE * cylinder.length), min(max(cylinder.length, near), FARTHEST)
    beyond = barrel.end + np.linspace(0.0, ahead, LOOKED_AT)[:, None] * barrel.axis
    in_view = bool(ViewArrays.of(views).showing(barrel.end[None] + LEAST * barrel.axis).any())
    looking = (
        views_showing(beyond, views, ENOUGH_VIEWS)
        or views_showing(barrel.at(np.linspace(0.5, 1.0, LOOKED_AT)), views, ENOUGH_VIEWS)
        or list(views[:1])
    )
    pixel = pixel_at(barrel.end, looking)
    evidence = axial_evidence(Scene.of(cylinder, looking, others), at_end, ahead)
    if evidence is not None:
        inside = max(inside, evidence.unseen_before_end())
    position = np.arange(-inside, ahead, pixel / SAMPLES_PER_PIXEL, dtype=float)
    odds = -np.maximum(position, 0.0) / cylinder.length
    if evidence is not None:
        odds += before_bend(contour_odds(evidence, position), position, evidence, cylinder.radius, pixel)
    showing = views_showing(barrel.end[None], views, ENOUGH_VIEWS)
    if showing:
        around = position < near
        strength, seen = rim_strength(barrel, position[around], showing, others)
        rims = RIM_WORTH * np.maximum(all_around(strength, seen), 0.0)
        odds[around] += rims
        if evidence is not None:
            odds[evidence.is_hidden(position)] += max(float(rims.max(initial=0.0)) - by_chance(pixel), 0.0)
    return EndPosterior.of_odds(position, odds, RIM_SIGMA * pixel, in_view)


def contour_odds(evidence: AxialEvidence, position: FloatArray) -> FloatArray:
    """Log odds (T,), up to a constant, that the contour stops at the positions (T,) [m]."""
    step = float(evidence.along[1] - evidence.along[0])
    between = np.append(evidence.along - 0.5 * step, evidence.along[-1] + 0.5 * step)
    return np.asarray(np.interp(position, between, np.append(0.0, np.cumsum(evidence.log_odds))))
