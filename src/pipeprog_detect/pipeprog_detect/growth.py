"""How far a pipe goes on beyond what is known of it: along its axis while the keyframes show its outlines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.edges import outline_edges
from pipeprog_detect.outline import frame, viewing_direction
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.support import SupportProfile, hits, support_profile

# A known length tells the direction well enough to look this far ahead, in its own lengths and in metres.
AHEAD, FARTHEST = 1.0, 1.5
# Pixels between the places looked at, places that are judged together, and the stations that suffice for one end.
SPACING, WINDOW, STATIONS = 6, 5, 2400
# The pipe goes on where its outlines show edges at this share of the rate at which the known part beside them does:
# texture shows them at up to six tenths of it on a thin pipe. Each side has to do half as well.
KEPT, KEPT_ON_A_SIDE = 0.75, 0.5
# Pixels beside the pipe where texture alone is seen, and by how much the pipe's rate must surpass that.
BESIDE, LEAST_CONTRAST = 4.0, 0.15
# Views that must see a place, and places times views and sides that make a rate.
MIN_VIEWS, MIN_SAMPLES = 2, 10
# Bare outlines end it, but for a clamp of so many radii or metres; what is hidden may be as long as an occluder.
CLAMP_RADII, CLAMP, HIDDEN = 3.0, 0.06, 0.3
# Growth by less than this is left to the rims [m].
LEAST = 0.04
# The direction's error, at the end of the stretch looked at, moves the outlines by less than this [px].
TOLERANCE = 1.5


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
    ends = []
    for end, axis in ((cylinder.start, -cylinder.axis), (cylinder.end, cylinder.axis)):
        ends.append(end + _further(cylinder, end, axis, views, others, view_offset, blur) * axis)
    return Cylinder(ends[0], ends[1], cylinder.radius)


def _further(
    cylinder: Cylinder,
    end: FloatArray,
    axis: FloatArray,
    views: Sequence[View],
    others: Sequence[Cylinder],
    view_offset: FloatArray,
    blur: float,
) -> float:
    """How far [m] beyond `end` the pipe goes on along `axis`, 0 where it does not."""
    ahead = min(AHEAD * cylinder.length, FARTHEST)
    back = min(0.5 * cylinder.length, 0.5 * FARTHEST)
    stretch = Cylinder(end - back * axis, end + ahead * axis, cylinder.radius)
    basis = frame(stretch, viewing_direction(stretch, views))
    at, edges = outline_edges(stretch, views, others, basis, view_offset, TOLERANCE, blur, SPACING, STATIONS)
    if not len(at):
        return 0.0
    profile = support_profile(at, hits(at, edges, view_offset))
    place = profile.along + 0.5 * (ahead - back)
    known, beyond = place < 0, place > 0
    if beyond.sum() < WINDOW or profile.seen[known].sum() < MIN_SAMPLES:
        return 0.0
    rate = profile.hits[known].sum() / profile.seen[known].sum()
    clamp = max(CLAMP_RADII * cylinder.radius, CLAMP)
    judged, goes_on = _judged(profile, beyond, KEPT * rate)
    if _end_of(place[beyond], judged, goes_on, clamp) == 0.0:
        return 0.0
    # Beside the pipe texture alone shows edges: the pipe's have to stand out from those.
    aside = (2.0 * cylinder.radius + BESIDE / float(np.median(at.gain))) * basis[0]
    shifted = Cylinder(end + aside, end + aside + ahead * axis, cylinder.radius)
    at, edges = outline_edges(shifted, views, others, basis, view_offset, TOLERANCE, blur, SPACING, STATIONS)
    chance = float(hits(at, edges, view_offset).mean()) if len(at) else 0.0
    if rate - chance < LEAST_CONTRAST:
        return 0.0
    judged, goes_on = _judged(profile, beyond, max(KEPT * rate, 0.5 * (rate + chance)))
    return _end_of(place[beyond], judged, goes_on, clamp)


def _judged(
    profile: SupportProfile, beyond: NDArray[np.bool_], least: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the places `beyond` the end (M of them) are seen well enough, and which show edges at a rate `least`."""
    window = np.ones(WINDOW)
    seen = np.stack([np.convolve(side, window, mode="same") for side in profile.seen[beyond].T])
    found = np.stack([np.convolve(side, window, mode="same") for side in profile.hits[beyond].T])
    judged = (seen.sum(axis=0) >= MIN_SAMPLES) & (profile.seen[beyond].max(axis=1) >= MIN_VIEWS)
    goes_on = (found.sum(axis=0) >= least * seen.sum(axis=0)) & (found >= KEPT_ON_A_SIDE * least * seen).all(axis=0)
    return judged, judged & goes_on


def _end_of(place: FloatArray, judged: NDArray[np.bool_], on: NDArray[np.bool_], clamp: float) -> float:
    """The last of the places (N,) [m] that belong to the pipe, given where it is judged and where it goes on."""
    step = float(place[1] - place[0])
    last = bare = shown = 0.0
    for here, is_judged, is_on in zip(place.tolist(), judged.tolist(), on.tolist(), strict=True):
        bare = 0.0 if is_on else bare + step * is_judged
        shown = shown + step if is_on else 0.0
        if bare > clamp or here - last > HIDDEN + shown:
            break
        # After a gap as much must be seen as the gap is long, or as much as a clamp would hide.
        if is_on and shown >= min(here - shown - last, clamp):
            last = here + 0.5 * step
    return last if last > LEAST else 0.0
