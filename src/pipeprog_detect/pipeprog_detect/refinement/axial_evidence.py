# SPDX-License-Identifier: Apache-2.0
"""What the contour tells along the axis, within a known part and beyond its end: the pipe, or what is beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import COMMON, HIT_RATE, TEXTURE, SupportProfile, hits, support_profile
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder

# A known part tells the direction well enough to look this far ahead [m]. How often the pipe shows edges
# is told by half as much of it.
FARTHEST = 1.5
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
# What is behind a pipe changes once in this length [m]: pipes and ducts in a rack behind it are some metres long.
UNCHANGED = 5.0
# Samples that make a known stretch.
MIN_SAMPLES = 10
# The direction's error, at the end of the stretch looked at, moves the contour by less than this [px].
TOLERANCE = 1.5


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

    def is_hidden(self, position: FloatArray) -> NDArray[np.bool_]:
        """Whether nothing is seen within a step of the positions (T,) [m], outwards from the end."""
        seen = self.along[self.seen > 0]
        away = np.abs(np.subtract.outer(position, seen)).min(axis=1, initial=np.inf)
        return np.asarray(away > float(np.diff(self.along).min()))

    def unseen_before_end(self) -> float:
        """Length [m] of the stretch before the end in which nothing is seen: the end was placed by other evidence."""
        seen = self.along[(self.along < 0.0) & (self.seen > 0.0)]
        return -float(seen.max(initial=self.along[0]))


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
    differs from `chance`, the rate of edges beside the pipe. Where what is behind it changes it shows edges as often as
    pipes do, and they may be brighter or darker.
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
    anywhere = np.array([1.0 - HIT_RATE, 0.5 * HIT_RATE, 0.5 * HIT_RATE])
    weight = 1.0 / (1.0 + COMMON * np.maximum(on.seen[position, side] - 1.0, 0.0))
    same = _of_all_views(samples, weight * np.log(likely / beside)[side, seen], known)
    changed = _of_all_views(samples, weight * np.log(anywhere / beside)[seen], known)
    return _with_changes(same, changed, int(known.sum()), float(on.along[1] - on.along[0]) / UNCHANGED)


def _of_all_views(samples: ContourSamples, odds: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """The log odds (B,) at each position, of those of the samples (N,).

    A view may fail to show the contour at all: its pose is off by more than edges count within, or what hides the pipe
    is not known. One that shows the `known` part is no such view; one that does not says little by not showing the pipe
    farther out.
    """
    position = samples.positions()[1]
    views, places = int(samples.view.max()) + 1, len(known)
    total = np.cumsum(
        np.bincount(samples.view * places + position, odds, views * places).reshape(views, places), axis=1
    )
    within = total[np.unique(samples.view[known[position]]), int(known.sum()) - 1]
    failed = FAILING / (FAILING + (1.0 - FAILING) * np.exp(within))
    failing = (float(failed.sum()) + FAILING * FAILING_SEEN) / (len(within) + FAILING_SEEN)
    return np.asarray(np.diff(np.logaddexp(np.log1p(-failing) + total, np.log(failing)).sum(axis=0), prepend=0.0))


def _with_changes(same: FloatArray, changed: FloatArray, known: int, change: float) -> FloatArray:
    """The log odds (B,) where what is behind the pipe may change from one position to the next.

    The forward algorithm of a hidden Markov model of two states (L. R. Rabiner, 1989).

    Args:
        same: log odds (B,) before what is behind the known positions.
        changed: log odds (B,) before anything else.
        known: number of the known positions, which come first.
        change: probability of a change from one position to the next; more than a half counts as that.
    """
    result = same.copy()
    change = min(change, 0.5)
    stay, leave = float(np.log1p(-change)), float(np.log(change))
    one, other, total = 0.0, -np.inf, 0.0
    for place in range(known, len(same)):
        one, other = np.logaddexp(one + stay, other + leave), np.logaddexp(other + stay, one + leave)
        one, other = one + same[place], other + changed[place]
        before, total = total, float(np.logaddexp(one, other))
        result[place] = total - before
    return result
