# SPDX-License-Identifier: Apache-2.0
"""Refinement of a cylinder by its apparent contour in the keyframes: radius and axis from all views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.contour_adjustment import AdjustedCylinder, adjusted, best_of
from pipeprog_detect.refinement.contour_fit import ContourFit, contour_fit
from pipeprog_detect.refinement.extension import RADIUS_HELD, followed, without_bend
from pipeprog_detect.refinement.global_search import MOST_SAMPLES, best_steps, distinct
from pipeprog_detect.refinement.one_sided import SeenArc, arc_precision, only_visible_side
from pipeprog_detect.refinement.pipe_ends import find_ends
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

# Search range of a pipe of known radius, in radii: of the radius, and of the axis, which is sought anew.
KNOWN_RADIUS, KNOWN_AXIS = 0.02, 0.5
# Search range of any other pipe: in standard deviations of the given radius (three of the axis; two and a half of the
# radius, which is known better), at least in pixels, and at most in radii, so that it stays one pipe.
AXIS_RANGE, RADIUS_RANGE = (3.0, 2.0, 0.4), (2.5, 2.0, 0.3)
# Standard deviation [m] of a radius that is fixed: less than a contour tells (0.1 mm).
RADIUS_FIXED = 1e-5
# The distance from the cameras, and the slope towards them, are sought within two of their standard deviations.
DEPTH_RANGE = 2.0
# Up to three results of the search, if their contours differ by this much [px rms], compete on sub-pixel edges with the
# start.
APART, CANDIDATES = 0.8, 3


@dataclass(frozen=True)
class Start:
    """A cylinder before its contour is measured, and what is known of it.

    Attributes:
        cylinder: where its contour is sought.
        radius_sigma: standard deviation of its radius [m]; that of its axis is taken as twice as large.
        radius_known: contours of other radii are not sought; a piece that is not extended keeps this one.
        radius_fixed: a known radius that the pipe's own edges do not change either.
        radius_error: standard deviation [m] of what is wrong with every edge of it in these images: a known radius is
            held the less, or it would push the pipe away to look as thin.
        depth_sigma: standard deviation of its distance from the cameras [m], where that is larger.
        slope_sigma: standard deviation of its slope towards the cameras [rad].
        ends_known: the cloud shows its surface between the ends.
        seen: what the cloud shows of it; where others hide one side in all views this takes the place of that side.
    """

    cylinder: Cylinder
    radius_sigma: float
    radius_known: bool = False
    depth_sigma: float = 0.0
    slope_sigma: float = np.inf
    ends_known: bool = False
    seen: SeenArc | None = None
    radius_fixed: bool = False
    radius_error: float = 0.0

    def precision(self) -> FloatArray:
        """(5, 5) precision [1/m^2] of the step of `Scene.moved`; the radius is left to the contour."""
        known_to = np.full(5, 2.0 * self.radius_sigma)
        known_to[[1, 3]] = max(2.0 * self.radius_sigma, self.depth_sigma)
        known_to[4] = np.inf
        slope = np.array([0.0, -1.0, 0.0, 1.0, 0.0]) / (self.slope_sigma * self.cylinder.length)
        return np.diag(1.0 / known_to**2) + np.outer(slope, slope)


def refine(
    start: Start,
    views: Sequence[View],
    others: Sequence[Cylinder],
    planned_radii: Sequence[float] = (),
    follow: bool = True,
) -> ContourFit | None:
    """The cylinder that the contours in all views agree on, or None where they tell too little.

    Two stages: a search over all edges near the predicted contour, which finds the one rigid cylinder that explains
    most of them, since a shadow's or a neighbour's edge drifts against the pipe as the camera moves; then robust least
    squares on sub-pixel limb edges. The ends follow from the end rims.

    Args:
        start: the cylinder, and what is known of it.
        views: the keyframes.
        others: further cylinders, which may hide this one.
        planned_radii: radii [m] at which the search starts, too.
        follow: whether the pipe is made as long as its contour is seen, and its ends are sought.
    """
    if not views:
        return None
    scene = Scene.of(start.cylinder, views, others)
    first = _first_steps(start, scene, planned_radii)
    if first is None:
        return None
    steps, prior = first
    if any(view.blur is None for view in views):
        scene = replace(scene, blur=scene.moved(steps[0]).measured_blur())
    held = prior.copy()
    held[4, 4] = 1.0 / ((RADIUS_FIXED if start.radius_fixed else RADIUS_HELD) ** 2 + start.radius_error**2)
    priors = [held] if start.radius_known else [prior]
    if start.radius_known and follow and not start.radius_fixed:
        priors.append(prior)  # the pipe's own edges, once found, tell the radius
    step = best_of(scene, steps, priors[0])
    found: AdjustedCylinder | None = None
    for each in priors:
        found = adjusted(scene.moved(step), each, step)
        if found is None:
            return None
        step = step + found.step
    if found is not None and start.ends_known:
        found = without_bend(found, start.cylinder, priors[-1])
    if found is None or found.share < MIN_SUPPORT:  # nothing that goes on: what is hardly seen is not followed
        return None
    if follow:
        found = followed(found, start.cylinder, priors[-1], held)
    if found.share < MIN_SUPPORT or found.is_within_blur:
        return None
    surface = start.cylinder if start.ends_known else None
    return contour_fit(found, find_ends(found.scene, surface) if follow else (None, None))


def _first_steps(start: Start, scene: Scene, planned_radii: Sequence[float]) -> tuple[FloatArray, FloatArray] | None:
    """Candidate steps (K, 5), best first, and the precision (5, 5) of the start; None where too little is seen."""
    samples = scene.samples(limit=MOST_SAMPLES)
    if len(np.unique(samples.view)) >= 2 and samples.shows_both_sides():
        reach, furthest = _search_range(start, float(np.median(samples.gain)), float(samples.gain.max()))
        near = [value - start.cylinder.radius for value in planned_radii]
        near = [value for value in near if abs(value) < reach[4]]
        seeds = np.zeros((len(near), 5))
        seeds[:, 4] = near
        profiles = scene.wide_profiles(samples, furthest)
        tilt = DEPTH_RANGE * start.slope_sigma * start.cylinder.length
        steps = distinct(best_steps(samples, profiles, reach, seeds, tilt), samples, APART, CANDIDATES)
        # The start itself is nearer than what the search prefers where another edge lies beside the contour.
        return np.vstack([steps, np.zeros(5)]), start.precision()
    side = None if start.seen is None else only_visible_side(scene)
    if start.seen is None or side is None:
        return None
    return np.zeros((1, 5)), arc_precision(start.seen, side)


def _search_range(start: Start, gain: float, most_gain: float) -> tuple[FloatArray, float]:
    """Range (5,) of the step [m], and by how much it moves the contour at the most [px]; `gain`s in px/m."""
    pixel, radius, sigma = 1.0 / gain, start.cylinder.radius, start.radius_sigma
    if start.radius_known:
        aside, thicker = KNOWN_AXIS * radius, max(KNOWN_RADIUS * radius, 0.3 * pixel)
    else:
        aside, thicker = (
            float(np.clip(sigmas * sigma, pixels * pixel, radii * radius))
            for sigmas, pixels, radii in (AXIS_RANGE, RADIUS_RANGE)
        )
    deep = max(aside, DEPTH_RANGE * start.depth_sigma)
    return np.array([aside, deep, aside, deep, thicker]), (aside + thicker) * most_gain
