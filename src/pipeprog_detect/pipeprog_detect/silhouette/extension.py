"""How far a pipe goes on beyond what is known of it: along its axis while the keyframes show its outlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import frame, viewing_direction
from pipeprog_detect.silhouette.edge_support import SupportProfile, hits, support_profile
from pipeprog_detect.silhouette.limb_edges import outline_edges
from pipeprog_detect.types import Cylinder, View

# A known length tells the direction well enough to look this far ahead, in its own lengths and in metres.
AHEAD, FARTHEST = 1.0, 1.5
# Pixels between the places looked at, and the stations that suffice for one end, and for a rate beside it.
SPACING, STATIONS, STATIONS_BESIDE = 6, 2400, 600
# Pixels beside the pipe where texture alone is seen, and by how much the pipe's rate must surpass that.
BESIDE, LEAST_CONTRAST = 4.0, 0.15
# Where little is seen beside the pipe, texture is taken to show edges at this rate, as if so many had been looked at.
TEXTURE, TEXTURE_SEEN = 0.2, 20.0
# Of what one place shows so much is common to all views: a speck of texture, a dark stretch.
COMMON = 0.3
# Outlines differ along a pipe: a place without edges speaks no louder against it than one with edges for it.
LEAST_RATE, MOST_RATE = 0.02, 0.9
# Logarithm of the odds that make a further stretch certain: texture is taken for it once in a thousand times.
CERTAIN = 7.0
# Stations that make a known stretch.
MIN_SAMPLES = 10
# Bare outlines end it, but for a clamp of so many radii or metres; what is hidden may be as long as an occluder.
CLAMP_RADII, CLAMP, HIDDEN = 3.0, 0.06, 0.3
# Growth by less than this is left to the rims [m].
LEAST = 0.04
# The direction's error, at the end of the stretch looked at, moves the outlines by less than this [px].
TOLERANCE = 1.5


@dataclass(frozen=True)
class Evidence:
    """What the outlines say at places `along` (N,) [m] outwards from an end of a pipe, those inside it negative.

    `log_odds` (N,): logarithm of how much more probable the edges seen there are on the pipe than beside it, 0 where
    nothing is seen; `seen` (N,): stations seen in all views.
    """

    along: FloatArray
    log_odds: FloatArray
    seen: FloatArray


def grown(
    cylinder: Cylinder,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
) -> Cylinder:
    """The cylinder, as long as its outlines are seen; the same one where nothing is to be added.

    What hides the pipe is no evidence against it.
    """
    ahead = min(AHEAD * cylinder.length, FARTHEST)
    ends = []
    for at_end in (False, True):
        evidence = outline_evidence(cylinder, at_end, ahead, views, others, view_offset, blur)
        further = 0.0 if evidence is None else _further(evidence, max(CLAMP_RADII * cylinder.radius, CLAMP))
        ends.append(cylinder.end + further * cylinder.axis if at_end else cylinder.start - further * cylinder.axis)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def outline_evidence(
    cylinder: Cylinder,
    at_end: bool,
    ahead: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
) -> Evidence | None:
    """The evidence of the outlines up to `ahead` [m] beyond an end; None where the pipe does not stand out.

    Edges lie on the pipe's outlines as often as on its known half, and as often as beside it on what is no pipe.
    """
    axis, end = (cylinder.axis, cylinder.end) if at_end else (-cylinder.axis, cylinder.start)
    back = min(0.5 * cylinder.length, 0.5 * FARTHEST)
    basis = frame(cylinder, viewing_direction(cylinder, views))

    def profile(aside: float, inner: float, limit: int) -> tuple[SupportProfile | None, float]:
        shift = aside * basis[0]
        stretch = Cylinder(end - inner * axis + shift, end + ahead * axis + shift, cylinder.radius)
        at, edges = outline_edges(stretch, views, others, basis, view_offset, TOLERANCE, blur, SPACING, limit)
        if not len(at):
            return None, 0.0
        return support_profile(at, hits(at, edges, view_offset)), float(np.median(at.gain))

    on, gain = profile(0.0, back, STATIONS)
    if on is None:
        return None
    along = on.along + 0.5 * (ahead - back)
    known = along < 0
    if on.seen[known].sum() < MIN_SAMPLES:
        return None
    aside = 2.0 * cylinder.radius + BESIDE / gain
    flanks = [profile(sign * aside, 0.0, STATIONS_BESIDE)[0] for sign in (-1.0, 1.0)]
    beside = [each for each in flanks if each is not None]
    found, looked = (sum(float(getattr(each, name).sum()) for each in beside) for name in ("hits", "seen"))
    chance = (found + TEXTURE * TEXTURE_SEEN) / (looked + TEXTURE_SEEN)
    rate = on.hits[known].sum(axis=0) / np.maximum(on.seen[known].sum(axis=0), 1.0)
    if on.hits[known].sum() / on.seen[known].sum() - chance < LEAST_CONTRAST:
        return None
    rate = np.clip(rate, chance, MOST_RATE)
    share = on.hits / np.maximum(on.seen, 1.0)
    count = on.seen / (1.0 + COMMON * np.maximum(on.seen - 1.0, 0.0))
    against = np.log((1.0 - rate) / (1.0 - max(chance, LEAST_RATE)))
    log_odds = (count * (share * np.log(rate / max(chance, LEAST_RATE)) + (1.0 - share) * against)).sum(axis=1)
    return Evidence(along, log_odds, on.seen.sum(axis=1))


def _further(evidence: Evidence, clamp: float) -> float:
    """How far [m] the pipe goes on: to where the evidence for it is greatest, 0 where it is not certain."""
    beyond = evidence.along > 0
    along, log_odds, seen = evidence.along[beyond], evidence.log_odds[beyond], evidence.seen[beyond]
    if len(along) < 2:
        return 0.0
    step = float(along[1] - along[0])
    total = most = last = bare = shown = 0.0
    for here, odds, stations in zip(along.tolist(), log_odds.tolist(), seen.tolist(), strict=True):
        total += odds
        bare = bare + step if stations and odds < 0 else 0.0 if odds > 0 else bare
        shown += step if odds > 0 else 0.0
        if bare > clamp + 2.0 * step or here - last > HIDDEN + shown:
            break
        if total > most + (CERTAIN if last == 0.0 or here - last > clamp else 0.0):
            most, last = total, here + 0.5 * step
    return last if last > LEAST else 0.0
