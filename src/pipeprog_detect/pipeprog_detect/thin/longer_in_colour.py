# SPDX-License-Identifier: Apache-2.0
"""Thin pipes as long as their colour shows them: in grey, copper may be as light as what is behind it for a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_detect.refinement.extension import LEAST, MAX_EXTENSIONS, extended
from pipeprog_detect.refinement.pipe_ends import find_end
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe

ROUNDING = 1e-9  # m: an end that has not moved is calculated anew from the other one


def longer_in_colour(
    measured: Sequence[MeasuredPipe], thickest: float, coloured: Sequence[View], beside: Sequence[Cylinder] = ()
) -> list[MeasuredPipe]:
    """The pipes, of which those thinner than `thickest` [m] reach as far as the `coloured` views show them at least.

    Their axis and radius stay: edges in colour are off by more than those in grey. `beside`: further cylinders.
    """
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> MeasuredPipe:
        others = [*cylinders[:number], *cylinders[number + 1 :], *beside]
        return _longer(measured[number], coloured, others) if cylinders[number].radius < thickest else measured[number]

    return mapped(one, range(len(measured))) if coloured else list(measured)


def _longer(measured: MeasuredPipe, views: Sequence[View], others: Sequence[Cylinder]) -> MeasuredPipe:
    """The pipe followed in the views, with the ends that they show where they make it longer."""
    known = measured.cylinder
    scene = Scene.of(known, views, others)
    scene = replace(scene, blur=scene.measured_blur())
    whole = known
    for _ in range(MAX_EXTENSIONS):
        longer = extended(scene.turned_to(whole))
        if longer.length < whole.length + LEAST:
            break
        whole = longer
    if whole is known:
        return measured
    first, last = whole.along(np.stack([known.start, known.end])).tolist()
    grown = first > ROUNDING, last < whole.length - ROUNDING
    rims = list(measured.rims)
    for at_end in (False, True):
        if grown[at_end]:
            end = find_end(scene.turned_to(whole), at_end, None)
            rims[at_end] = 0.0 if end is None else end.odds
            whole = whole if end is None else whole.lengthened(at_end, end.position)
    fit = None if measured.fit is None else measured.fit.on(whole)
    candidate = replace(measured.candidate, cylinder=measured.candidate.cylinder.cut_like(whole))
    return replace(measured, candidate=candidate, cylinder=whole, rims=(rims[0], rims[1]), fit=fit)
