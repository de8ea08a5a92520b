# SPDX-License-Identifier: Apache-2.0
"""What became of each planned pipe whose place is known: installed, missing, hidden, not seen, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_detect.coverage.axes import AxisCoverage, axis_coverage
from pipeprog_detect.coverage.places import Sight
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import PlannedState
from pipeprog_detect.types import View

# A barrel ends where its fitting begins: up to the leg of a long elbow, 1.5 diameters, beyond an installed end nothing
# is said to be missing.
FITTING_RADII = 3.0


@dataclass(frozen=True)
class PlannedCoverage:
    """A planned pipe in metres of its axis; what they leave are its fittings.

    Attributes:
        state: of the planned pipe against those found.
        missing: in view, and the keyframes see through its place.
        unclear: in view, but something stands there, or the pipe is too thin for the depths to tell.
        hidden: something lies before it.
        not_seen: out of view, or too small in all images.
    """

    state: PlannedState
    missing: float
    unclear: float
    hidden: float
    not_seen: float

    @property
    def planned(self) -> PlannedPipe:
        """The pipe of the plan."""
        return self.state.planned

    @property
    def word(self) -> str:
        """The state that most of its metres have: `installed`, `missing`, `unclear`, `hidden` or `not_seen`."""
        names = ("installed", "missing", "unclear", "hidden", "not_seen")
        metres = (self.state.length, self.missing, self.unclear, self.hidden, self.not_seen)
        return names[int(np.argmax(metres))]


def planned_coverage(states: Sequence[PlannedState], views: Sequence[View]) -> list[PlannedCoverage]:
    """The coverage of each planned pipe, whose places are those of the views' map, in their order."""
    coverage = axis_coverage([state.planned.cylinder for state in states], views)
    return [_of(state, own) for state, own in zip(states, coverage, strict=True)]


def _of(state: PlannedState, own: AxisCoverage) -> PlannedCoverage:
    at, margin = own.positions(), FITTING_RADII * state.planned.cylinder.radius
    open_parts = np.ones(len(at), bool)
    for low, high in state.stretches:
        open_parts &= (at < low - margin) | (at > high + margin)
    missing, unclear, hidden, not_seen = (
        own.metres(sight, within=open_parts) for sight in (Sight.EMPTY, Sight.OPEN, Sight.HIDDEN, Sight.NOT_SEEN)
    )
    return PlannedCoverage(state, missing, unclear, hidden, not_seen)
