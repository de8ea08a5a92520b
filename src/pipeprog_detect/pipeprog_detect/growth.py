"""How far a pipe goes on beyond what is known of it: along its axis while the keyframes show its outlines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_detect.edges import outline_edges
from pipeprog_detect.outline import frame, viewing_direction
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.support import MIN_SHARE, hits, support_profile

# That a pipe goes on straight is likely beforehand: two views show it.
MIN_VIEWS = 2
# A known length tells the direction well enough to look this far ahead, in its own lengths and in metres.
AHEAD, FARTHEST = 1.0, 1.5
# Pixels between the places looked at, places that are judged together, and the stations that suffice for one end.
SPACING, WINDOW, STATIONS = 6, 5, 1200
# The pipe goes on where the outlines keep this share of the support that they have along what is known of it, ...
KEPT = 0.5
# ... but for gaps up to what a clamp or an occluder explains: so many radii or metres.
GAP_RADII, GAP = 10.0, 0.3
# Growth by less than this is left to the rims [m].
LEAST = 0.04
# The direction's error, at the end of the stretch looked at, moves the outlines by less than this [px].
TOLERANCE = 1.5


def grown(
    cylinder: Cylinder,
    share: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
) -> Cylinder:
    """The cylinder, as long as its outlines are supported; `share` is their support along what is known of it.

    What hides the pipe is no evidence against it. The same cylinder where nothing is to be added.
    """
    ends = []
    for end, axis in ((cylinder.start, -cylinder.axis), (cylinder.end, cylinder.axis)):
        ends.append(end + _further(cylinder, end, axis, share, views, others, view_offset, blur) * axis)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def _further(
    cylinder: Cylinder,
    end: FloatArray,
    axis: FloatArray,
    share: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
) -> float:
    """How far [m] beyond `end` the pipe goes on along `axis`, 0 where it does not."""
    ahead = min(AHEAD * cylinder.length, FARTHEST)
    stretch = Cylinder(end, end + ahead * axis, cylinder.radius)
    basis = frame(stretch, viewing_direction(stretch, views))
    at, edges = outline_edges(stretch, views, others, basis, view_offset, TOLERANCE, blur, SPACING, STATIONS)
    if not len(at):
        return 0.0
    profile = support_profile(at, hits(at, edges, view_offset))
    judged = profile.seen >= MIN_VIEWS
    supported = judged & (profile.hits >= MIN_VIEWS) & (profile.hits >= MIN_SHARE * profile.seen)
    place = profile.along + 0.5 * ahead
    if len(place) < WINDOW:
        return 0.0
    window = np.ones(WINDOW)
    count = np.convolve(judged.sum(axis=1), window, mode="same")
    found = np.convolve(supported.sum(axis=1), window, mode="same")
    goes_on = (count > 0) & (found >= KEPT * share * count)
    # Both outlines of a pipe go on; one alone is the edge of something else.
    sides = [np.convolve(supported[:, side], window, mode="same") for side in (0, 1)]
    goes_on &= np.minimum(*sides) >= 0.4 * np.convolve(judged.min(axis=1), window, mode="same") * KEPT * share
    gap = max(GAP_RADII * cylinder.radius, GAP)
    last, shown = 0.0, 0.0
    step = float(place[1] - place[0])
    for here, on in zip(place, goes_on, strict=True):
        if here - last > gap:
            break
        if on:
            # After a gap as much must be seen as the gap is long, up to the pipe's own width.
            shown = shown + step if here - last < 2.5 * step or shown > 0 else step
            if here - last < 2.5 * step or shown >= min(here - last, 4.0 * cylinder.radius):
                last, shown = float(here) + 0.5 * step, 0.0
        else:
            shown = 0.0
    return last if last > LEAST else 0.0
