# SPDX-License-Identifier: Apache-2.0
"""How far a pipe goes along its axis: beyond its known part, and on a stub no farther, than its contour is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.contour_adjustment import MODEL_ERROR, AdjustedCylinder, adjusted
from pipeprog_detect.silhouette.edge_support import COMMON, TEXTURE, SupportProfile, hits, support_profile
from pipeprog_detect.silhouette.free_space import free_stretches
from pipeprog_detect.silhouette.global_search import MOST_SAMPLES, best_steps
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder

# A known length tells the direction well enough to look this far ahead: in its own lengths, and at most in metres.
AHEAD, FARTHEST = 1.0, 1.5
# Spacing of the contour samples [px], and how many suffice along one end and along one line beside it.
SPACING, SAMPLES, SAMPLES_BESIDE = 6, 2400, 600
# Distance beside the pipe at which texture alone is seen [px], and by how much the pipe's rate of edges must exceed
# that of texture.
BESIDE, LEAST_CONTRAST = 4.0, 0.15
# Number of samples that the prior rate of texture's edges weighs: it counts where little is seen beside.
TEXTURE_SEEN = 20.0
# What a sample shows: no edge, or one that is brighter or darker within the contour than this far beside it [px].
NO_EDGE, BRIGHTER, DARKER = 0, 1, 2
STEP_AT = np.array([-1.5, 1.5])
# One view in twenty fails to show a contour; the number of views that this prior weighs.
FAILING, FAILING_SEEN = 0.05, 20.0
# Bounds of the rates: contours differ along a pipe, so that neither an edge nor its absence is ever certain evidence.
LEAST_RATE, MOST_RATE = 0.02, 0.9
# Logarithm of the odds from which a further stretch is taken for the pipe's: wrong once in a thousand times.
CERTAIN = 7.0
# Samples that make a known stretch.
MIN_SAMPLES = 10
# A stretch without edges ends the pipe if it is longer than a clamp: in radii, and at least in metres. A hidden stretch
# may be as long as what hides it [m].
CLAMP_RADII, CLAMP, HIDDEN = 3.0, 0.06, 0.3
# Extension by less than this is left to the search for the end rim [m].
LEAST = 0.04
# The direction's error, at the end of the stretch looked at, moves the contour by less than this [px].
TOLERANCE = 1.5

# Standard deviation [m] to which a known radius is held until the pipe's own edges are found.
RADIUS_HELD = 1e-4
# Standard deviations within which what is known of a direction is sought.
SURELY = 3.0
# Extensions of a piece, each by up to its own length at either end: to 3^6 times its length at the most.
MAX_EXTENSIONS = 6
# An extension is rejected (radius and axis stay those known before) if support drops below this share of its former
# value, if the radius changes by more than this many standard deviations, ...
WORSE, SAME_RADIUS = 0.9, 3.0
# ... or if the axis moves by more than this (chi square of four degrees of freedom, exceeded once in a thousand times)
# and by more than this share of the radius: it then follows a pipe beside it.
SAME_AXIS, ASIDE = 18.5, 0.5
# The cloud's surface goes on around an elbow (of a long radius, EN 10253) for 4 radii beyond the barrel. Of what is
# shorter than twice that half may be the elbow.
WITH_BEND = 8.0
# Support of a stub of which half is straight, with what the first third of the bend adds, which is nearly straight.
HALF_SEEN = 0.7
# Rounds in which a stub is cut to where its contour is seen.
CUTS = 3
# With less than this share of the former support it is not extended at all: there is something else.
LOST = 0.5


@dataclass(frozen=True)
class AxialEvidence:
    """What the contour tells at positions along the axis, outwards from an end of a pipe.

    Attributes:
        along: position (N,) [m]; those inside the end are negative.
        log_odds: logarithm (N,) of how much more probable the edges seen there are on the pipe than beside it; 0 where
            nothing is seen.
        seen: number (N,) of samples seen there in all views.
    """

    along: FloatArray
    log_odds: FloatArray
    seen: FloatArray

    def beyond(self) -> tuple[FloatArray, FloatArray]:
        """Positions (M,) from the end on [m], and the sums (M,) of the log odds up to each: none at the end itself."""
        outside = self.along > 0.0
        return np.append(0.0, self.along[outside]), np.append(0.0, np.cumsum(self.log_odds[outside]))


def followed(known: AdjustedCylinder, start: Cylinder, prior: FloatArray, held: FloatArray) -> AdjustedCylinder:
    """A pipe of which a piece is known, as long as its contour is seen.

    `prior` (5, 5): precision [1/m^2] of the piece's `start`; `held`: the same with the radius held.
    """
    for _ in range(MAX_EXTENSIONS):
        length = known.cylinder.length
        longer = extended(known.scene)
        if longer.length < length + LEAST:
            turned = _turned(known, held)
            longer = longer if turned is None else extended(turned)
        if longer.length < length + LEAST:
            break
        # The prior's direction came from the shorter piece: the longer one's ends are more uncertain by their ratio.
        weaker = prior * (length / longer.length) ** 2
        scene = known.scene.turned_to(longer)
        again = adjusted(scene, weaker, _step_from(start, scene))
        if again is None or again.share < LOST * known.share:
            break
        if again.share < WORSE * known.share or _widens(again, known) or _strays(again.cylinder, known):
            # There may be more of the pipe that measures it less well.
            known = replace(known, scene=replace(known.scene, cylinder=longer))
        else:
            known = again
    return known


def without_bend(known: AdjustedCylinder, start: Cylinder, prior: FloatArray) -> AdjustedCylinder:
    """A stub between the positions from which on its contour is not seen; what is longer stays as it is.

    The cloud's surface goes on around an elbow, whose edges lead the axis of a stub aside. `prior` (5, 5): precision
    [1/m^2] of the `start`.
    """
    for _ in range(CUTS):
        cylinder = known.cylinder
        if cylinder.length > WITH_BEND * cylinder.radius or known.share > HALF_SEEN:
            break
        scene = replace(known.scene, cylinder=_where_seen(known))
        shorter = adjusted(scene, prior, _step_from(start, scene))
        if shorter is None or shorter.share <= known.share:
            break
        known = shorter
    return known


def _where_seen(known: AdjustedCylinder) -> Cylinder:
    """The stretch of a cylinder whose edges are most probable on a pipe; all of it where none are."""
    profile = support_profile(known.samples, known.hit)
    total = np.append(0.0, np.cumsum(profile.log_odds()))
    least = np.minimum.accumulate(total)
    last = int(np.argmax(total - least))
    first = int(np.argmin(total[: last + 1]))
    if first == last:
        return known.cylinder
    half = 0.5 * known.cylinder.length
    between = np.concatenate([[-half], 0.5 * (profile.along[1:] + profile.along[:-1]), [half]])
    return known.cylinder.cut(float(between[first]) + half, float(between[last]) + half)


def _step_from(start: Cylinder, scene: Scene) -> FloatArray:
    """Step (5,) of `Scene.moved` that leads from the start's axis, prolonged, to the scene's cylinder."""
    cylinder = scene.cylinder
    ends = np.stack([cylinder.start, cylinder.end])
    offset = ends - start.start
    aside = (offset - np.outer(offset @ start.axis, start.axis)) @ scene.basis.T
    return np.append(aside.ravel(), cylinder.radius - start.radius)


def _widens(longer: AdjustedCylinder, known: AdjustedCylinder) -> bool:
    """Whether a longer cylinder has another radius than the known one."""
    sigma = np.sqrt(known.covariance[4, 4] + (MODEL_ERROR / np.median(longer.samples.gain)) ** 2)
    return bool(abs(longer.cylinder.radius - known.cylinder.radius) > SAME_RADIUS * sigma)


def _strays(longer: Cylinder, known: AdjustedCylinder) -> bool:
    """Whether the axis of a longer cylinder leaves the ends of the known one."""
    ends = np.stack([known.cylinder.start, known.cylinder.end]) - longer.start
    aside = (np.outer(ends @ longer.axis, longer.axis) - ends) @ known.scene.basis.T
    offset = aside.ravel()
    systematic = MODEL_ERROR / float(np.median(known.samples.gain))
    covariance = known.covariance[:4, :4] + systematic**2 * np.eye(4)
    surely = float(offset @ np.linalg.solve(covariance, offset)) > SAME_AXIS
    return surely and float(np.linalg.norm(aside, axis=1).max()) > ASIDE * known.cylinder.radius


def _turned(known: AdjustedCylinder, held: FloatArray) -> Scene | None:
    """The known cylinder in the direction that most edges ahead of it agree with.

    None where its direction is known well enough to look ahead, or where too little is seen there.
    """
    cylinder = known.cylinder
    share = min(AHEAD, FARTHEST / cylinder.length)
    further = share * cylinder.length * cylinder.axis
    ends = np.kron([[1.0 + share, -share], [-share, 1.0 + share]], np.eye(2))
    reach = SURELY * np.sqrt(np.diag(ends @ known.covariance[:4, :4] @ ends.T))
    gain = float(np.median(known.samples.gain))
    if reach.max() * gain < TOLERANCE:
        return None
    longer = Cylinder(cylinder.start - further, cylinder.end + further, cylinder.radius)
    ahead = replace(known.scene, cylinder=longer)
    samples = ahead.samples().thinned(MOST_SAMPLES)
    if not len(samples):
        return None
    furthest = reach.max() * float(samples.gain.max())
    profiles = ahead.wide_profiles(samples, furthest)
    steps = best_steps(samples, profiles, np.append(reach, RADIUS_HELD))
    turned = adjusted(ahead.moved(steps[0]), held, np.zeros(5))
    if turned is None:
        return None
    half = 0.5 * cylinder.length * turned.cylinder.axis
    middle = turned.cylinder.middle
    return replace(known.scene, cylinder=Cylinder(middle - half, middle + half, cylinder.radius))


def extended(scene: Scene) -> Cylinder:
    """The scene's cylinder, as long as its contour is seen; the same one where nothing is to be added.

    Where something hides the pipe there is no evidence against it; where the views see through it, it ends.
    """
    cylinder = scene.cylinder
    ahead = min(AHEAD * cylinder.length, FARTHEST)
    ends = []
    for at_end in (False, True):
        evidence = axial_evidence(scene, at_end, ahead)
        further = 0.0 if evidence is None else _further(evidence, max(CLAMP_RADII * cylinder.radius, CLAMP))
        end, out = (cylinder.end, cylinder.axis) if at_end else (cylinder.start, -cylinder.axis)
        if further:
            free = free_stretches(Cylinder(end, end + further * out, cylinder.radius), scene.views, scene.others)
            further = min([further, *(first for first, _ in free)])
        ends.append(end + further * out)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def axial_evidence(scene: Scene, at_end: bool, ahead: float) -> AxialEvidence | None:
    """The evidence of the contour up to `ahead` [m] beyond an end; None where the pipe does not stand out.

    The pipe's contour shows edges as often as on the known half next to that end; what is no pipe shows them as often
    as the lines beside it.
    """
    cylinder = scene.cylinder
    axis, end = (cylinder.axis, cylinder.end) if at_end else (-cylinder.axis, cylinder.start)
    back = min(0.5 * cylinder.length, 0.5 * FARTHEST)
    scene = scene.turned_to(cylinder)

    def beyond(aside: float, inner: float) -> Scene:
        shift = aside * scene.basis[0]
        return replace(
            scene, cylinder=Cylinder(end - inner * axis + shift, end + ahead * axis + shift, cylinder.radius)
        )

    ahead_of = beyond(0.0, back)
    samples, edges = ahead_of.own_edges(TOLERANCE, SPACING, SAMPLES)
    hit = hits(edges, scene.shift_of(samples))
    on = support_profile(samples, hit)
    along = on.along + 0.5 * (ahead - back)
    known = along < 0
    if on.seen[known].sum() < MIN_SAMPLES or len(along) < 2:
        return None
    aside = 2.0 * cylinder.radius + BESIDE / on.gain
    chance = _chance([beyond(sign * aside, 0.0).support(TOLERANCE, SPACING, SAMPLES_BESIDE) for sign in (-1.0, 1.0)])
    light = ahead_of.light(samples, STEP_AT, SPACING)
    seen = np.where(hit, np.where(light[:, 0] > light[:, 1], BRIGHTER, DARKER), NO_EDGE)
    odds = _log_odds(samples, seen, on, known, chance)
    return None if odds is None else AxialEvidence(along, odds, on.seen.sum(axis=1))


def _chance(beside: list[SupportProfile]) -> float:
    """The rate of edges on lines beside the pipe."""
    found, looked = (sum(float(getattr(each, name).sum()) for each in beside) for name in ("hits", "seen"))
    return max((found + TEXTURE * TEXTURE_SEEN) / (looked + TEXTURE_SEEN), LEAST_RATE)


def _log_odds(
    samples: ContourSamples, seen: IntArray, on: SupportProfile, known: NDArray[np.bool_], chance: float
) -> FloatArray | None:
    """The logarithm (B,) of the odds that what is `seen` (N,) at each position is the pipe's, given all inner ones.

    How often each outcome occurs on each side of the pipe is taken from its `known` positions (B,): a pipe is brighter
    than what is behind it, or darker, along most of a side, where edges of texture are either. None where that hardly
    differs from `chance`, the rate of edges beside the pipe.

    A view may fail to show the contour at all: its pose is off by more than edges count within, or what hides the pipe
    is not known. One that shows the known part is no such view; one that does not says little by not showing the pipe
    farther out.
    """
    position, side = samples.positions()[1], samples.side
    inner = known[position]
    count = np.bincount(3 * side[inner] + seen[inner], minlength=6).reshape(2, 3).astype(float)
    beside = np.array([1.0 - chance, 0.5 * chance, 0.5 * chance])
    hit = count[:, 1:].sum(axis=1, keepdims=True)
    rate = np.clip(hit / np.maximum(count.sum(axis=1, keepdims=True), 1.0), chance, MOST_RATE)
    of_hits = np.clip((count[:, 1:] + 1.0) / (hit + 2.0), 1.0 - MOST_RATE, MOST_RATE)
    likely = np.hstack([1.0 - rate, rate * of_hits])
    contrast = 0.5 * np.abs(likely - beside).sum(axis=1)
    if contrast @ count.sum(axis=1) < LEAST_CONTRAST * count.sum():
        return None
    weight = 1.0 / (1.0 + COMMON * np.maximum(on.seen[position, side] - 1.0, 0.0))
    odds = weight * np.log(likely / beside)[side, seen]
    views, places = int(samples.view.max()) + 1, len(known)
    total = np.cumsum(
        np.bincount(samples.view * places + position, odds, views * places).reshape(views, places), axis=1
    )
    within = total[np.unique(samples.view[inner]), int(known.sum()) - 1]
    failed = FAILING / (FAILING + (1.0 - FAILING) * np.exp(within))
    failing = (float(failed.sum()) + FAILING * FAILING_SEEN) / (len(within) + FAILING_SEEN)
    return np.diff(np.logaddexp(np.log1p(-failing) + total, np.log(failing)).sum(axis=0), prepend=0.0)


def _further(evidence: AxialEvidence, clamp: float) -> float:
    """How far [m] the pipe goes on: to where the evidence for it is greatest, 0 where it is not certain."""
    beyond = evidence.along > 0
    along, log_odds, seen = evidence.along[beyond], evidence.log_odds[beyond], evidence.seen[beyond]
    if len(along) < 2:
        return 0.0
    step = float(along[1] - along[0])
    total = most = last = bare = shown = 0.0
    for here, odds, samples in zip(along.tolist(), log_odds.tolist(), seen.tolist(), strict=True):
        total += odds
        bare = bare + step if samples and odds < 0 else 0.0 if odds > 0 else bare
        shown += step if odds > 0 else 0.0
        if bare > clamp + 2.0 * step or here - last > HIDDEN + shown:
            break
        if total > most + (CERTAIN if last == 0.0 or here - last > clamp else 0.0):
            most, last = total, here + 0.5 * step
    return last if last > LEAST else 0.0
