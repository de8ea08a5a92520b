# SPDX-License-Identifier: Apache-2.0
"""How far a pipe goes along its axis: beyond its known part, and on a stub no farther, than its contour is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.axial_evidence import FARTHEST, TOLERANCE, AxialEvidence, axial_evidence
from pipeprog_detect.refinement.contour_adjustment import MODEL_ERROR, AdjustedCylinder, adjusted
from pipeprog_detect.refinement.global_search import MOST_SAMPLES, best_steps
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import SupportProfile, support_profile
from pipeprog_detect.silhouette.free_space import free_stretches
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder

# A known length tells the direction well enough to look this far ahead, in its own lengths.
AHEAD = 1.0
# Logarithm of the odds from which a further stretch is taken for the pipe's: wrong once in a thousand times.
CERTAIN = 7.0
# A stretch without edges ends the pipe if it is longer than a clamp: in radii, and at least in metres. A hidden stretch
# may be as long as what hides it [m].
CLAMP_RADII, CLAMP, HIDDEN = 3.0, 0.06, 0.3
# Extension by less than this is left to the search for the end rim [m].
LEAST = 0.04

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
# Rounds in which a stub is cut to where its contour is seen, and the least length of what is left, in radii: a shorter
# piece tells its axis no better than its radius, and one position of the contour may show edges by chance.
CUTS, LEAST_STUB = 3, 2.0
# With less than this share of the former support it is not extended at all: there is something else.
LOST = 0.5


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
        scene = replace(known.scene, cylinder=where_seen(cylinder, support_profile(known.samples, known.hit)))
        if scene.cylinder.length < LEAST_STUB * cylinder.radius:
            break
        shorter = adjusted(scene, prior, _step_from(start, scene))
        if shorter is None or shorter.share <= known.share:
            break
        known = shorter
    return known


def where_seen(cylinder: Cylinder, profile: SupportProfile) -> Cylinder:
    """The stretch of a cylinder whose edges are most probable on a pipe; all of it where none are."""
    total = np.append(0.0, np.cumsum(profile.log_odds().sum(axis=1)))
    least = np.minimum.accumulate(total)
    last = int(np.argmax(total - least))
    first = int(np.argmin(total[: last + 1]))
    if first == last:
        return cylinder
    half = 0.5 * cylinder.length
    between = np.concatenate([[-half], 0.5 * (profile.along[1:] + profile.along[:-1]), [half]])
    return cylinder.cut(float(between[first]) + half, float(between[last]) + half)


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
    covariance = ends @ known.covariance[:4, :4] @ ends.T
    if SURELY * _contour_sigma(known.samples, covariance) < TOLERANCE:
        return None
    reach = SURELY * np.sqrt(np.diag(covariance))
    longer = Cylinder(cylinder.start - further, cylinder.end + further, cylinder.radius)
    ahead = replace(known.scene, cylinder=longer)
    samples = ahead.samples(limit=MOST_SAMPLES)
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


def _contour_sigma(samples: ContourSamples, covariance: FloatArray) -> float:
    """Standard deviation [px] of the contour at the ends, whose `covariance` (4, 4) is given, of the view with most.

    A step away from the cameras moves it by the parallax between these alone.
    """
    aside = samples.jacobian[:, 0:2] + samples.jacobian[:, 2:4]  # for a step of both ends
    variances = [np.einsum("ni,ij,nj->n", aside, covariance[k : k + 2, k : k + 2], aside) for k in (0, 2)]
    return float(np.sqrt(np.max(variances)))


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
            beyond = Cylinder(end, end + further * out, cylinder.radius)
            free = free_stretches(beyond, scene.views, scene.others, known=cylinder)
            further = min([further, *(first for first, _ in free)])
        ends.append(end + further * out)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def _further(evidence: AxialEvidence, clamp: float) -> float:
    """How far [m] the pipe goes on: to where the evidence for it is greatest, 0 where it is not certain."""
    beyond = evidence.along > 0
    along, log_odds, seen = evidence.along[beyond], evidence.log_odds[beyond], evidence.seen[beyond]
    if len(along) < 2:
        return 0.0
    step = float(along[1] - along[0])
    total = most = last = bare = shown = against = lacking = 0.0
    for here, odds, samples in zip(along.tolist(), log_odds.tolist(), seen.tolist(), strict=True):
        total += odds
        bare = bare + step if samples and odds < 0 else 0.0 if odds > 0 else bare
        shown += step if odds > 0 else 0.0
        # One edge that happens to lie in a gap does not close it: evidence for the pipe must outweigh that against it.
        against = min(against + odds, 0.0)
        lacking = 0.0 if against == 0.0 else lacking + step if samples else lacking
        is_gap = lacking > clamp + 2.0 * step and against < -CERTAIN
        if is_gap or bare > clamp + 2.0 * step or here - last > HIDDEN + shown:
            break
        if total > most + (CERTAIN if last == 0.0 or here - last > clamp else 0.0):
            most, last = total, here + 0.5 * step
    return last if last > LEAST else 0.0
