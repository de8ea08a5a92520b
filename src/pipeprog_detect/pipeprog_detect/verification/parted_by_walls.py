# SPDX-License-Identifier: Apache-2.0
"""Pipes in line on both sides of a wall: each is one of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_detect.refinement.extension import LEAST_STUB
from pipeprog_detect.refinement.pipe_ends import find_end
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.walls_across import stretches_in_walls


def parted_by_walls(
    measured: Sequence[MeasuredPipe], context: SceneContext, views: Sequence[View], verifier: KeyframeVerifier
) -> list[MeasuredPipe]:
    """The pipes, and in place of each that passes a wall its parts on either side; what is within the wall is none.

    Pipes in line on both sides of a pillar look like one that something hides. What hides a pipe stands before it; a
    pillar reaches past it.
    """
    cylinders = [each.cylinder for each in measured]
    parts: list[MeasuredPipe] = []
    for number, each in enumerate(measured):
        others = cylinders[:number] + cylinders[number + 1 :]
        hidden = stretches_in_walls(each.cylinder, context, views, others)
        bounds = [0.0, *(end for stretch in hidden for end in stretch), each.cylinder.length]
        if not hidden:
            parts.append(each)
            continue
        for low, high in zip(bounds[::2], bounds[1::2], strict=True):
            if high - low > LEAST_STUB * each.cylinder.radius:
                parts.append(_part(each, low, high, views, others, verifier))
    return parts


def _part(
    whole: MeasuredPipe,
    low: float,
    high: float,
    views: Sequence[View],
    others: Sequence[Cylinder],
    verifier: KeyframeVerifier,
) -> MeasuredPipe:
    """The part of a pipe from `low` to `high` [m from its start], measured anew, with the ends seen before the walls.

    Where no end is seen it ends at the wall.
    """
    candidate, length = whole.part(low, high), whole.cylinder.length
    between = candidate.cylinder
    part = verifier.measured(candidate, others, False) or replace(whole, candidate=candidate, cylinder=between)
    cylinder, rims = part.cylinder, part.rims
    if cylinder.axis @ between.axis < 0.0:
        cylinder, rims = replace(cylinder, start=cylinder.end, end=cylinder.start), rims[::-1]
    first, last = cylinder.along(np.stack([between.start, between.end])).tolist()
    # It has grown again into the wall, behind which something in line with it is seen.
    grown = [low > 0.0 and first > 0.0, high < length and last < cylinder.length]
    cut = cylinder.cut(first if grown[0] else 0.0, last if grown[1] else cylinder.length)
    scene = Scene.of(cut, views, others)
    ends = [find_end(scene, at_end, None) if grown[at_end] else None for at_end in (False, True)]
    for at_end, end in enumerate(ends):
        cut = cut.lengthened(bool(at_end), min(end.position, 0.0)) if end is not None else cut
    start, stop = (
        rim if not has_grown else 0.0 if end is None else end.odds
        for rim, has_grown, end in zip(rims, grown, ends, strict=True)
    )
    return replace(part, cylinder=cut, rims=(start, stop))
