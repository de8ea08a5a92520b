"""Refinement of a cylinder by its apparent contour in the keyframes: radius and axis from all views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.contour_adjustment import ROBUST, AdjustedCylinder, adjusted, best_of, flatness
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.extension import AHEAD, FARTHEST, LEAST, TOLERANCE, extended
from pipeprog_detect.silhouette.global_search import MOST_SAMPLES, best_steps, distinct
from pipeprog_detect.silhouette.one_sided import SeenArc, arc_precision, only_visible_side, shows_both_sides
from pipeprog_detect.silhouette.pipe_ends import End, find_end
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

# The limb model's own error, common to all views: a tenth of a sharp image's blur [px].
MODEL_ERROR = 0.05
# Where the contour is not seen, edges of texture take its place, spread evenly within the robust loss [px].
CLUTTER_ERROR = ROBUST / np.sqrt(3.0)
# Search range of a pipe of known radius, in radii: of the radius, and of the axis, which is sought anew.
KNOWN_RADIUS, KNOWN_AXIS = 0.02, 0.5
# Standard deviation [m] to which a known radius is held until the pipe's own edges are found.
RADIUS_HELD = 1e-4
# Search range of any other pipe: in standard deviations of the given radius (three of the axis; two and a half of the
# radius, which is known better), at least in pixels, and at most in radii, so that it stays one pipe.
AXIS_RANGE, RADIUS_RANGE = (3.0, 2.0, 0.4), (2.5, 2.0, 0.3)
# The distance from the cameras is sought within two of its standard deviations.
DEPTH_RANGE = 2.0
# Results of the search compete on sub-pixel edges where their contours differ by this much [px rms]; at most so many.
APART, CANDIDATES = 0.8, 3
# Standard deviations within which what is known of a direction is sought.
SURELY = 3.0
# A pipe of which a piece is known is extended so many times at most, each time up to its own length at either end.
MAX_EXTENSIONS = 6
# An extension is rejected (radius and axis stay those known before) if support drops below this share of its former
# value, if the radius changes by more than this many standard deviations, ...
WORSE, SAME_RADIUS = 0.9, 3.0
# ... or if the axis moves by more than this (chi square of four degrees of freedom, exceeded once in a thousand times)
# and by more than this share of the radius: it then follows a pipe beside it.
SAME_AXIS, ASIDE = 18.5, 0.5
# With less than this share of the former support it is not extended at all: there is something else.
LOST = 0.5


@dataclass(frozen=True)
class ContourFit:
    """A cylinder measured by its apparent contour.

    Attributes:
        cylinder: the cylinder.
        covariance: (5, 5) of the axis' offset at its middle (2) [m], its direction (2) [rad] and the radius [m]; the
            directions are across the axis, sideways as the views see it and away from them.
        radius_sigma: standard deviation of the radius [m].
        support: share (0 to 1) of the visible contour with an edge in three views or more.
        views: number of views used.
        rims: evidence for an end rim at the start and at the end (`pipe_ends.End.odds`).
        flatness: 0 for a cylinder, whose contour keeps its distance from the axis from all sides; 1 for a painted strip
            or a joint, whose edges stay where they are.
        flatness_sigma: its standard deviation.
    """

    cylinder: Cylinder
    covariance: FloatArray
    radius_sigma: float
    support: float
    views: int
    rims: tuple[float, float]
    flatness: float
    flatness_sigma: float


@dataclass(frozen=True)
class Start:
    """A cylinder before its contour is measured, and what is known of it.

    Attributes:
        cylinder: where its contour is sought.
        radius_sigma: standard deviation of its radius [m]; that of its axis is taken as twice as large.
        radius_known: contours of other radii are not sought; a piece that is not extended keeps this one.
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
    cylinder, scene = start.cylinder, Scene.of(start.cylinder, views, others)
    first = _first_steps(start, scene, planned_radii)
    if first is None:
        return None
    steps, prior = first
    scene = scene.with_measured_blur(scene.moved(cylinder, steps[0]))
    held = prior.copy()
    held[4, 4] = 1.0 / RADIUS_HELD**2
    first_prior = held if start.radius_known else prior
    step = best_of(cylinder, scene, list(steps), first_prior)
    found = adjusted(scene.moved(cylinder, step), scene, first_prior, step)
    if found is not None and start.radius_known and follow:  # its own edges, once found, tell the radius
        step = step + found.step
        found = adjusted(scene.moved(cylinder, step), scene, prior, step)
    if found is not None and follow:
        found, scene = _extended(found, scene, prior, held)
    if found is None or found.share < MIN_SUPPORT:
        return None
    return _result(found, views, _ends(start, found, scene) if follow else [None, None])


def _first_steps(start: Start, scene: Scene, planned_radii: Sequence[float]) -> tuple[FloatArray, FloatArray] | None:
    """Candidate steps (K, 5), best first, and the precision (5, 5) of the start; None where too little is seen."""
    samples = scene.samples(start.cylinder)
    if len(np.unique(samples.view)) >= 2 and shows_both_sides(samples):
        samples = samples.thinned(MOST_SAMPLES)
        reach, furthest = _search_range(start, float(np.median(samples.gain)), float(samples.gain.max()))
        near = [value - start.cylinder.radius for value in planned_radii]
        near = [value for value in near if abs(value) < reach[4]]
        seeds = np.zeros((len(near), 5))
        seeds[:, 4] = near
        steps = best_steps(scene, samples, reach, furthest, seeds)
        return distinct(steps, samples, APART, CANDIDATES), start.precision()
    side = None if start.seen is None else only_visible_side(start.cylinder, scene)
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


def _extended(
    known: AdjustedCylinder, scene: Scene, prior: FloatArray, held: FloatArray
) -> tuple[AdjustedCylinder, Scene]:
    """A pipe of which a piece is known, as long as its contour is seen, and the scene of its solution."""
    for _ in range(MAX_EXTENSIONS):
        length = known.cylinder.length
        shifted = scene.shifted(known.view_offset)
        longer = extended(known.cylinder, shifted)
        if longer.length < length + LEAST:
            turned = _turned(known, scene, held)
            longer = longer if turned is None else extended(turned, shifted)
        if longer.length < length + LEAST:
            break
        # The prior's direction came from the shorter piece: the longer one's ends are more uncertain by their ratio.
        weaker = prior * (length / longer.length) ** 2
        ahead = scene.turned_to(longer)
        again = adjusted(longer, ahead, weaker, np.zeros(5))
        if again is None or again.share < LOST * known.share:
            break
        if again.share < WORSE * known.share or _widens(again, known) or _strays(again.cylinder, known, scene.basis):
            known = replace(known, cylinder=longer)  # there may be more of it that measures it less well
        else:
            known, scene = again, ahead
    return known, scene.shifted(known.view_offset)


def _widens(longer: AdjustedCylinder, known: AdjustedCylinder) -> bool:
    """Whether a longer cylinder has another radius than the known one."""
    sigma = np.sqrt(known.covariance[4, 4] + (MODEL_ERROR / np.median(longer.samples.gain)) ** 2)
    return bool(abs(longer.cylinder.radius - known.cylinder.radius) > SAME_RADIUS * sigma)


def _strays(longer: Cylinder, known: AdjustedCylinder, basis: FloatArray) -> bool:
    """Whether the axis of a longer cylinder leaves the ends of the known one, whose step's frame is `basis` (2, 3)."""
    ends = np.stack([known.cylinder.start, known.cylinder.end]) - longer.start
    aside = (np.outer(ends @ longer.axis, longer.axis) - ends) @ basis.T
    offset = aside.ravel()
    systematic = MODEL_ERROR / float(np.median(known.samples.gain))
    covariance = known.covariance[:4, :4] + systematic**2 * np.eye(4)
    surely = float(offset @ np.linalg.solve(covariance, offset)) > SAME_AXIS
    return surely and float(np.linalg.norm(aside, axis=1).max()) > ASIDE * known.cylinder.radius


def _turned(known: AdjustedCylinder, scene: Scene, held: FloatArray) -> Cylinder | None:
    """The known cylinder in the direction that most edges ahead of it agree with.

    None where its direction is known well enough to look ahead, or where too little is seen there.
    """
    cylinder = known.cylinder
    share = min(AHEAD, FARTHEST / cylinder.length)
    further = share * cylinder.length * cylinder.axis
    longer = Cylinder(cylinder.start - further, cylinder.end + further, cylinder.radius)
    ends = np.kron([[1.0 + share, -share], [-share, 1.0 + share]], np.eye(2))
    reach = SURELY * np.sqrt(np.diag(ends @ known.covariance[:4, :4] @ ends.T))
    gain = float(np.median(known.samples.gain))
    if reach.max() * gain < TOLERANCE:
        return None
    samples = scene.samples(longer).thinned(MOST_SAMPLES)
    if not len(samples):
        return None
    furthest = reach.max() * float(samples.gain.max())
    steps = best_steps(scene, samples, np.append(reach, RADIUS_HELD), furthest)
    turned = adjusted(scene.moved(longer, steps[0]), scene, held, np.zeros(5))
    if turned is None:
        return None
    half = 0.5 * cylinder.length * turned.cylinder.axis
    return Cylinder(turned.cylinder.middle - half, turned.cylinder.middle + half, cylinder.radius)


def _ends(start: Start, found: AdjustedCylinder, scene: Scene) -> list[End | None]:
    """What the views tell of the found pipe's start and end."""
    given, whole = start.cylinder, found.cylinder
    further = float((given.start - whole.start) @ whole.axis), float((whole.end - given.end) @ whole.axis)
    return [
        find_end(whole, at_end, scene, -max(beyond, 0.0) if start.ends_known else None)
        for at_end, beyond in zip((False, True), further, strict=True)
    ]


def _result(found: AdjustedCylinder, views: Sequence[View], ends: Sequence[End | None]) -> ContourFit:
    cylinder = found.cylinder
    length, axis = cylinder.length, cylinder.axis
    from_ends = np.zeros((5, 5))
    from_ends[0:2, 0:2] = from_ends[0:2, 2:4] = 0.5 * np.eye(2)
    from_ends[2:4, 0:2] = -np.eye(2) / length
    from_ends[2:4, 2:4] = np.eye(2) / length
    from_ends[4, 4] = 1.0
    systematic = np.hypot(MODEL_ERROR, CLUTTER_ERROR * (1.0 - found.share)) / float(np.median(found.samples.gain))
    covariance = from_ends @ (found.covariance + systematic**2 * np.eye(5)) @ from_ends.T
    start, end = ends
    measured = Cylinder(
        cylinder.start - (start.position if start else 0.0) * axis,
        cylinder.end + (end.position if end else 0.0) * axis,
        cylinder.radius,
    )
    return ContourFit(
        measured,
        covariance,
        float(np.sqrt(covariance[4, 4])),
        found.share,
        len(np.unique(found.samples.view[found.used])),
        (start.odds if start else 0.0, end.odds if end else 0.0),
        *flatness(found, views),
    )
