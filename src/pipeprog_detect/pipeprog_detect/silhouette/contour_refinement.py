"""Refinement of a cylinder by its outlines in the keyframes: radius and axis from all views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.config import ContourConfig
from pipeprog_detect.silhouette.apparent_contour import (
    Stations,
    frame,
    moved,
    stations,
    viewing_direction,
    visible,
)
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT, hits, support_profile
from pipeprog_detect.silhouette.extension import AHEAD, FARTHEST, LEAST, TOLERANCE, grown
from pipeprog_detect.silhouette.global_search import distinct, vote
from pipeprog_detect.silhouette.limb_edges import LimbEdges, estimate_blur, outline_edges, sideways
from pipeprog_detect.silhouette.one_sided import SeenArc, lone_limb, precision, shows_both
from pipeprog_detect.silhouette.pipe_ends import End, find_end
from pipeprog_detect.types import Cylinder, View

# Pixels of outline that make one measurement: the mean over them tames texture, the line stays straight within.
CHUNK = 12
# Scale of the robust loss [px] and of the unresolved error of one edge within a blur of its place [px].
ROBUST, FLOOR = 0.3, 0.1
# A tenth of the blur remains as the limb model's own error, common to all views [px]; where the outline is not seen,
# edges of texture take its place, spread evenly within the robust loss.
MODEL_ERROR, CLUTTER_ERROR = 0.05, ROBUST / np.sqrt(3.0)
# A pipe of a known radius has it within so much, and its axis may lie so many radii aside: it is sought anew.
KNOWN_RADIUS, KNOWN_AXIS = 0.02, 0.5
# ... and held to so much [m] until its own edges are found.
RADIUS_HELD = 1e-4
# Where the vote cannot tell, so many candidates compete on sub-pixel edges.
CANDIDATES = 3
# Stations that suffice for a vote.
VOTERS = 1500
# Standard deviations within which what is known of a direction is sought.
SURELY = 3.0
# Edges count within so many pixels of the vote's and of the refined outlines.
COARSE_REACH, FINE_REACH, FINE_PASSES = 2.5, 1.5, 3
MIN_STATIONS = 20
# A pipe of which a piece is known is followed so many times, each time as far again.
MAX_GROWTH = 6
# Where more of it has so much less support, or another radius by so many standard deviations, what was known before
# gives radius and axis; as where its axis moves by more than once in a thousand times (chi square of four degrees of
# freedom), and by more radii than that: a pipe beside it has lent its outlines.
WORSE, SAME_RADIUS = 0.9, 3.0
SAME_AXIS, ASIDE = 18.5, 0.5
# ... and where it has less than half, it was something else.
LOST = 0.5


@dataclass(frozen=True)
class ContourFit:
    """A cylinder measured by its outlines.

    `covariance` (5, 5) of the axis' offset at its middle (2) [m], its direction (2) [rad] and the radius [m], the
    directions being those of `basis` (2, 3); `support` share of the outline with an edge in three views or more;
    `views` number of views used; `start_sigma`, `end_sigma` [m], NaN where the images do not show that end and the
    given one stands; `rims` what speaks for a rim at the start and at the end (`rim.End.odds`). `flatness`, with its
    standard deviation `flatness_sigma`: 0 for a cylinder, whose outlines keep their distance from the axis from all
    sides; 1 for a painted strip or a joint, whose edges stay where they are.
    """

    cylinder: Cylinder
    covariance: FloatArray
    basis: FloatArray
    radius_sigma: float
    support: float
    views: int
    start_sigma: float
    end_sigma: float
    rims: tuple[float, float]
    flatness: float
    flatness_sigma: float


@dataclass(frozen=True)
class Start:
    """A cylinder before its outlines are asked, and what is known of it.

    Attributes:
        cylinder: where its outlines are sought.
        radius_sigma: standard deviation of its radius [m]; that of its axis is taken as twice as much.
        radius_known: outlines of other radii are not looked for; a piece that is not followed keeps this one.
        depth_sigma: what the distance from the cameras is known to [m], where that is worse.
        slope_sigma: what the slope towards the cameras is known to [rad].
        ends_known: the surface was seen between the ends.
        seen: what the cloud holds of it; where others hide one of its outlines in all views it stands for that one.
    """

    cylinder: Cylinder
    radius_sigma: float
    radius_known: bool = False
    depth_sigma: float = 0.0
    slope_sigma: float = np.inf
    ends_known: bool = False
    seen: SeenArc | None = None

    def precision(self) -> FloatArray:
        """(5, 5) [1/m^2] of `outline.moved`'s step; the radius is left to the outlines."""
        known_to = np.full(5, 2.0 * self.radius_sigma)
        known_to[[1, 3]] = max(2.0 * self.radius_sigma, self.depth_sigma)
        known_to[4] = np.inf
        slope = np.array([0.0, -1.0, 0.0, 1.0, 0.0]) / (self.slope_sigma * self.cylinder.length)
        return np.diag(1.0 / known_to**2) + np.outer(slope, slope)


def refine(
    start: Start,
    views: Sequence[View],
    others: Sequence[Cylinder],
    config: ContourConfig,
    planned_radii: Sequence[float] = (),
    follow: bool = True,
) -> ContourFit | None:
    """The cylinder that the outlines in all views agree on, or None where they say too little or are not to be used.

    `others` are further cylinders that may hide this one; `planned_radii` only seed the vote. With `follow` the pipe is
    made as long as its outlines are seen, and its ends are looked for.

    Two stages: a vote over all edges near the predicted outlines (`consensus.vote`), which finds the one rigid
    cylinder that explains most of them, since a shadow's or a neighbour's edge drifts against the pipe as the camera
    moves; then robust least squares on limb-aware sub-pixel edges. The ends follow from the rims (`rim.find_end`).
    """
    if not config.enabled or not views:
        return None
    cylinder, seen = start.cylinder, start.seen
    basis = frame(cylinder, viewing_direction(cylinder, views))
    candidates, prior = _vote(start, views, others, basis, planned_radii), start.precision()
    if not len(candidates):
        limb = None if seen is None else lone_limb(cylinder, views, others, basis, CHUNK)
        if seen is None or limb is None:
            return None
        candidates, prior = np.zeros((1, 5)), precision(seen, limb)
    scene = (views, others, basis)
    still: FloatArray = np.zeros(len(views))
    blur = estimate_blur(moved(cylinder, basis, candidates[0]), *scene, still, CHUNK)
    held = prior.copy()
    held[4, 4] = 1.0 / RADIUS_HELD**2
    first = held if start.radius_known else prior
    trials = [_improved(cylinder, candidate, scene, blur, first) for candidate in candidates]
    step, _ = max(trials, key=lambda trial: trial[1])
    refined = _fine(moved(cylinder, basis, step), scene, blur, first, step)
    if refined is not None and start.radius_known and follow:  # its own edges, once found, tell the radius
        step = step + refined.step
        refined = _fine(moved(cylinder, basis, step), scene, blur, prior, step)
    if refined is not None and follow:
        refined, basis = _followed(refined, scene, blur, prior, held)
    if refined is None or refined.share < MIN_SUPPORT:
        return None
    ends: list[End | None] = [None, None]
    if follow:
        offset = refined.solution.view_offset
        whole, axis = refined.cylinder, refined.cylinder.axis
        further = float((cylinder.start - whole.start) @ axis), float((whole.end - cylinder.end) @ axis)
        ends = [
            find_end(whole, at_end, views, others, offset, blur, -max(beyond, 0.0) if start.ends_known else None)
            for at_end, beyond in zip((False, True), further, strict=True)
        ]
    return _result(refined, basis, views, ends)


@dataclass(frozen=True)
class _Refined:
    """A cylinder after the steps (5,) of least squares, its stations' edges and the share of them that support it."""

    cylinder: Cylinder
    step: FloatArray
    solution: _Solution
    share: float
    at: Stations
    edges: LimbEdges


def _followed(
    known: _Refined,
    scene: tuple[Sequence[View], Sequence[Cylinder], FloatArray],
    blur: float,
    prior: FloatArray,
    held: FloatArray,
) -> tuple[_Refined, FloatArray]:
    """A pipe of which a piece is known, as long as its outlines are seen, and the frame (2, 3) of its solution."""
    views, others, basis = scene
    for _ in range(MAX_GROWTH):
        length, offset = known.cylinder.length, known.solution.view_offset
        longer = grown(known.cylinder, views, others, offset, blur)
        if longer.length < length + LEAST:
            swung = _swung(known, (views, others, basis), blur, held)
            longer = longer if swung is None else grown(swung, views, others, offset, blur)
        if longer.length < length + LEAST:
            break
        # The direction that was known of the shorter one leaves the longer one's ends uncertain by as much more.
        weaker = prior * (length / longer.length) ** 2
        turned = frame(longer, viewing_direction(longer, views))
        again = _fine(longer, (views, others, turned), blur, weaker, np.zeros(5))
        if again is None or again.share < LOST * known.share:
            break
        if again.share < WORSE * known.share or _widens(again, known) or _strays(again.cylinder, known, basis):
            known = replace(known, cylinder=longer)  # there may be more of it that is of less use to measure it by
        else:
            known, basis = again, turned
    return known, basis


def _widens(longer: _Refined, known: _Refined) -> bool:
    """Whether a longer cylinder has another radius than the known one."""
    sigma = np.sqrt(known.solution.covariance[4, 4] + (MODEL_ERROR / np.median(longer.at.gain)) ** 2)
    return bool(abs(longer.cylinder.radius - known.cylinder.radius) > SAME_RADIUS * sigma)


def _strays(longer: Cylinder, known: _Refined, basis: FloatArray) -> bool:
    """Whether the axis of a longer cylinder leaves the ends of the known one, whose step's frame is `basis` (2, 3)."""
    ends = np.stack([known.cylinder.start, known.cylinder.end]) - longer.start
    aside = (np.outer(ends @ longer.axis, longer.axis) - ends) @ basis.T
    offset = aside.ravel()
    systematic = MODEL_ERROR / float(np.median(known.at.gain))
    covariance = known.solution.covariance[:4, :4] + systematic**2 * np.eye(4)
    surely = float(offset @ np.linalg.solve(covariance, offset)) > SAME_AXIS
    return surely and float(np.linalg.norm(aside, axis=1).max()) > ASIDE * known.cylinder.radius


def _swung(
    known: _Refined, scene: tuple[Sequence[View], Sequence[Cylinder], FloatArray], blur: float, held: FloatArray
) -> Cylinder | None:
    """The known cylinder in the direction that most edges ahead of it agree with.

    None where its direction is known well enough to look ahead, or where too little is seen there.
    """
    views, others, basis = scene
    cylinder = known.cylinder
    share = min(AHEAD, FARTHEST / cylinder.length)
    further = share * cylinder.length * cylinder.axis
    longer = Cylinder(cylinder.start - further, cylinder.end + further, cylinder.radius)
    ends = np.kron([[1.0 + share, -share], [-share, 1.0 + share]], np.eye(2))
    reach = SURELY * np.sqrt(np.diag(ends @ known.solution.covariance[:4, :4] @ ends.T))
    gain = float(np.median(known.at.gain))
    if reach.max() * gain < TOLERANCE:
        return None
    at = stations(longer, views, basis, CHUNK)
    at = _some(at.select(visible(longer, others, views, at)))
    if not len(at):
        return None
    steps = vote(views, at, np.append(reach, RADIUS_HELD), reach.max() * float(at.gain.max()), CHUNK // 2)
    swung = _fine(moved(longer, basis, steps[0]), scene, blur, held, np.zeros(5))
    if swung is None:
        return None
    middle = swung.cylinder.middle
    half = 0.5 * cylinder.length * swung.cylinder.axis
    return Cylinder(middle - half, middle + half, cylinder.radius)


def _fine(
    cylinder: Cylinder,
    scene: tuple[Sequence[View], Sequence[Cylinder], FloatArray],
    blur: float,
    prior: FloatArray,
    so_far: FloatArray,
) -> _Refined | None:
    """A few passes of least squares, the edges sought anew in each; None where that leaves no cylinder."""
    views, _, basis = scene
    view_offset: FloatArray = np.zeros(len(views))
    step: FloatArray = np.zeros(5)
    for _ in range(FINE_PASSES):
        current = moved(cylinder, basis, step)
        if current.radius <= 0:
            return None
        at, edges = outline_edges(current, *scene, view_offset, _reach(current, views, FINE_REACH), blur, CHUNK)
        if len(at) < MIN_STATIONS:
            return None
        solution = _solve(at, edges, len(views), prior, so_far + step)
        step = step + solution.step
        view_offset = solution.view_offset
    share = support_profile(at, hits(at, _moved_by(edges, at, solution), view_offset)).share
    found = moved(cylinder, basis, step)
    return _Refined(found, step, solution, share, at, edges) if found.radius > 0 else None


def _reach(cylinder: Cylinder, views: Sequence[View], pixels: float) -> float:
    """`pixels`, but less on a thin pipe, whose two outlines and highlight lie within a few pixels."""
    distance = [np.linalg.norm(view.centre - cylinder.middle) for view in views]
    half_width = [view.camera.fx * cylinder.radius / each for view, each in zip(views, distance, strict=True)]
    return float(min(pixels, max(0.3 * np.median(half_width), 0.6)))


def _vote(
    start: Start,
    views: Sequence[View],
    others: Sequence[Cylinder],
    basis: FloatArray,
    planned_radii: Sequence[float],
) -> FloatArray:
    """Steps (K, 5) of `outline.moved` that most edges of all views support, best first; none where no two see it."""
    cylinder, sigma = start.cylinder, start.radius_sigma
    at = stations(cylinder, views, basis, CHUNK)
    at = at.select(visible(cylinder, others, views, at))
    if len(np.unique(at.view)) < 2 or not shows_both(at):
        return np.zeros((0, 5))
    at = _some(at)
    pixel = 1.0 / float(np.median(at.gain))
    radius = cylinder.radius
    aside = float(np.clip(3.0 * sigma, 2.0 * pixel, 0.4 * radius))
    thicker = float(np.clip(2.5 * sigma, 2.0 * pixel, 0.3 * radius))
    if start.radius_known:
        aside, thicker = KNOWN_AXIS * radius, max(KNOWN_RADIUS * radius, 0.3 * pixel)
    deep = max(aside, 2.0 * start.depth_sigma)
    reach = np.array([aside, deep, aside, deep, thicker])
    near = [value - radius for value in planned_radii if abs(value - radius) < thicker]
    seeds = np.zeros((len(near), 5))
    seeds[:, 4] = near
    best = vote(views, at, reach, (aside + thicker) * float(at.gain.max()), CHUNK // 2, seeds)
    return distinct(best, at, 0.8, CANDIDATES)


def _some(at: Stations) -> Stations:
    """Stations that suffice for a vote."""
    return at.select(np.arange(0, len(at), max(len(at) // VOTERS, 1)))


def _improved(
    cylinder: Cylinder,
    step: FloatArray,
    scene: tuple[Sequence[View], Sequence[Cylinder], FloatArray],
    blur: float,
    prior: FloatArray,
) -> tuple[FloatArray, float]:
    """A candidate step after one pass on sub-pixel edges, and the share of stations that it explains."""
    views, _, basis = scene
    still: FloatArray = np.zeros(len(views))
    current = moved(cylinder, basis, step)
    reach = _reach(current, views, COARSE_REACH)
    at, edges = outline_edges(current, *scene, still, reach, blur, CHUNK, 1200)
    if len(at) < MIN_STATIONS:
        return step, 0.0
    solution = _solve(at, edges, len(views), prior, step)
    explained = hits(at, _moved_by(edges, at, solution), solution.view_offset)
    return step + solution.step, float(explained.mean())


@dataclass(frozen=True)
class _Solution:
    """A step (5,) with its covariance (5, 5), the sideways offset (V,) of each view [px] and which stations spoke."""

    step: FloatArray
    covariance: FloatArray
    view_offset: FloatArray
    used: NDArray[np.bool_]


def _solve(at: Stations, edges: LimbEdges, count: int, prior: FloatArray, so_far: FloatArray) -> _Solution:
    """Robust least squares for the step (5,) with a sideways offset of each view as a random effect.

    There may be more unknowns: as many as the Jacobian has columns.
    A wrong pose moves both outlines of a view together, which says nothing about the radius: the offsets' variance is
    estimated from the views' scatter (expectation maximisation), so that with true poses they vanish. `prior` (5, 5) is
    the precision [1/m^2] of the start, from which `so_far` (5,) has led: where the views lie in a row along the pipe,
    only the cloud knows its distance.

    The covariance clusters the residuals by view and by place (sandwich estimator): edges along one line share the
    error of its pose, edges at one place that of its texture.
    """
    jacobian = at.jacobian
    sign = sideways(at)
    unknowns = jacobian.shape[1]
    step: FloatArray = np.zeros(unknowns)
    offset = np.zeros(count)
    variance = 0.25
    rows = np.arange(len(at))
    for _ in range(25):
        predicted = jacobian @ step + sign * offset[at.view]
        distance = np.where(np.isfinite(edges.offset), np.abs(edges.offset - predicted[:, None]), np.inf)
        nearest = np.argmin(distance, axis=1)
        used = np.isfinite(distance[rows, nearest]) & (edges.sigma[rows, nearest] < 0.7)
        seen = np.where(used, edges.offset[rows, nearest], 0.0)
        sigma = np.where(used, edges.sigma[rows, nearest], 1.0)
        residual = np.where(used, seen - predicted, 0.0)
        weight = used / (sigma**2 + FLOOR**2) / (1.0 + (residual / ROBUST) ** 2)
        weighted = jacobian * weight[:, None]
        own = np.bincount(at.view, weight, count) + 1.0 / variance
        cross = np.stack([np.bincount(at.view, sign * weighted[:, k], count) for k in range(unknowns)], axis=1)
        right = np.bincount(at.view, sign * weight * seen, count)
        normal = weighted.T @ jacobian - (cross / own[:, None]).T @ cross + prior
        normal += np.diag(np.full(unknowns, 1e-9 * np.trace(normal)))
        step = np.linalg.solve(normal, weighted.T @ seen - cross.T @ (right / own) - prior @ so_far)
        offset = (right - cross @ step) / own
        active = own > 2.0 / variance
        if active.any():
            variance = max(float(np.mean(offset[active] ** 2 + 1.0 / own[active])), 0.02**2)
    remaining = np.where(used, seen - jacobian @ step - sign * offset[at.view], 0.0)
    inverse = np.linalg.inv(normal)
    freed = weighted - (weight * sign)[:, None] * (cross / own[:, None])[at.view]
    spread = _clustered(weighted * remaining[:, None], at.view, used)
    spread = spread + _clustered(freed * remaining[:, None], _places(at), used)
    return _Solution(step, inverse @ spread @ inverse + inverse, offset, used)


def _flatness(refined: _Refined, views: Sequence[View]) -> tuple[float, float]:
    """Share of a strip's displacement that is in the edges, beside a step of the cylinder, and its sigma."""
    strip = _as_strip(refined.at, refined.cylinder, views)
    widened = replace(refined.at, jacobian=np.column_stack([refined.at.jacobian, strip]))
    solution = _solve(widened, refined.edges, len(views), np.zeros((6, 6)), np.zeros(6))
    return float(solution.step[5]), float(np.sqrt(solution.covariance[5, 5]))


def _as_strip(at: Stations, cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    """Outward displacement (N,) [px] of the outlines if a flat strip that faces the mean view were in their place.

    Seen from an angle off its normal a strip of half-width R looks R cos(angle) wide, a cylinder as wide as before.
    """
    towards = np.stack([view.centre - cylinder.middle for view in views])
    towards = towards - np.outer(towards @ cylinder.axis, cylinder.axis)
    towards = towards / (np.linalg.norm(towards, axis=1)[:, None] + 1e-12)
    facing = towards[np.unique(at.view)].sum(axis=0)
    facing = facing / (np.linalg.norm(facing) + 1e-12)
    return np.asarray(at.half_width * (towards @ facing - 1.0)[at.view], np.float64)


def _places(at: Stations) -> NDArray[np.int64]:
    """Index (N,) of each station's position along the axis: texture there is the same in all views."""
    return np.unique(np.round(at.along, 6), return_inverse=True)[1].astype(np.int64)


def _clustered(scores: FloatArray, group: NDArray[np.int64], used: NDArray[np.bool_]) -> FloatArray:
    """Sum (5, 5) of the outer products of the scores (N, 5) of each group, corrected for few groups."""
    total = np.stack([np.bincount(group, column) for column in scores.T], axis=1)
    groups = len(np.unique(group[used]))
    return total.T @ total * groups / max(groups - 3, 1)


def _moved_by(edges: LimbEdges, at: Stations, solution: _Solution) -> LimbEdges:
    """The edges as offsets from the solution's outline."""
    return LimbEdges(edges.offset - (at.jacobian @ solution.step)[:, None], edges.sigma, edges.explained)


def _result(refined: _Refined, basis: FloatArray, views: Sequence[View], ends: Sequence[End | None]) -> ContourFit:
    cylinder, solution, share, at = refined.cylinder, refined.solution, refined.share, refined.at
    length, axis = cylinder.length, cylinder.axis
    from_ends = np.zeros((5, 5))
    from_ends[0:2, 0:2] = from_ends[0:2, 2:4] = 0.5 * np.eye(2)
    from_ends[2:4, 0:2] = -np.eye(2) / length
    from_ends[2:4, 2:4] = np.eye(2) / length
    from_ends[4, 4] = 1.0
    systematic = np.hypot(MODEL_ERROR, CLUTTER_ERROR * (1.0 - share)) / float(np.median(at.gain))
    covariance = from_ends @ (solution.covariance + systematic**2 * np.eye(5)) @ from_ends.T
    start, end = ends
    measured = Cylinder(
        cylinder.start - (start.position if start else 0.0) * axis,
        cylinder.end + (end.position if end else 0.0) * axis,
        cylinder.radius,
    )
    return ContourFit(
        measured,
        covariance,
        basis,
        float(np.sqrt(covariance[4, 4])),
        share,
        len(np.unique(at.view[solution.used])),
        start.sigma if start else float("nan"),
        end.sigma if end else float("nan"),
        (start.odds if start else 0.0, end.odds if end else 0.0),
        *_flatness(refined, views),
    )
