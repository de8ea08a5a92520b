# SPDX-License-Identifier: Apache-2.0
"""Which planned pipes are installed where the plan has them, which lie elsewhere, and which were not found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.types import Cylinder

# A pipe this far from its planned place is the planned one, moved; further away it is another one. [m]
_REACH = 0.25
# Off by more, it is told [m]: fitters set brackets to a centimetre, and survey and control points are good to half one.
TOLERANCE = 0.02
_PARALLEL = np.cos(np.radians(5.0))  # a stub of 0.15 m whose ends are 5 mm off turns by 4 degrees
_SAME_SIZE = 0.05  # of the radius, for pipes without a class: steps between standard sizes are 6 % and more
_OVERLAP = 0.5  # of the shorter one that must lie side by side


@dataclass(frozen=True)
class FoundPipe:
    """A measured pipe in the plan's coordinates [m]; its class, empty where it has none."""

    id: str
    cylinder: Cylinder
    class_name: str


@dataclass(frozen=True)
class PlannedState:
    """What was found of a planned pipe.

    Attributes:
        planned: the pipe of the plan.
        found: ids of the measured pipes that it is, empty where none was found.
        length: how much of it is installed [m].
        across: greatest distance between planned and measured axis [m], 0 where none was found.
        along: by how far it lies further along its axis than planned [m].
        stretches: of the planned axis, from its start [m], beside which a measured pipe lies.
    """

    planned: PlannedPipe
    found: tuple[str, ...]
    length: float
    across: float
    along: float
    stretches: tuple[tuple[float, float], ...] = ()

    @property
    def state(self) -> str:
        """`installed`, `moved` (by more than TOLERANCE) or `not found`."""
        if not self.found:
            return "not found"
        return "moved" if max(self.across, abs(self.along)) > TOLERANCE else "installed"


@dataclass(frozen=True)
class _Pair:
    """A stretch along which a measured pipe runs beside a planned one: positions on both axes, distances [m]."""

    planned: int
    found: int
    on_planned: tuple[float, float]  # both ends of the measured pipe; they may lie beyond the planned one's
    beside: tuple[float, float]  # of them, what lies beside the planned pipe
    on_found: tuple[float, float]
    across: float


def installed_where_planned(planned: Sequence[PlannedPipe], found: Sequence[FoundPipe]) -> list[PlannedState]:
    """The state of each planned pipe, in their order.

    The nearest pairs are taken first, and each stretch of a measured pipe is one planned pipe's at most: so a pipe in a
    bundle is not taken for its neighbour that was moved. A pipe measured in pieces, or several as one, counts whole.
    """
    pairs = [
        pair
        for row, one in enumerate(planned)
        for column in _within_reach(one.cylinder, found)
        if (pair := _pair(row, column, one, found[column])) is not None
    ]
    taken: list[_Pair] = []
    for pair in sorted(pairs, key=lambda pair: (pair.across, pair.planned, pair.found)):
        rivals = [
            *((other.on_found, pair.on_found) for other in taken if other.found == pair.found),
            *((other.beside, pair.beside) for other in taken if other.planned == pair.planned),
        ]
        if all(_common(theirs, ours) < _OVERLAP * (ours[1] - ours[0]) for theirs, ours in rivals):
            taken.append(pair)
    return [_state(row, planned, taken, found) for row in range(len(planned))]


def _within_reach(cylinder: Cylinder, found: Sequence[FoundPipe]) -> list[int]:
    """Indices of the measured pipes whose box, grown by the reach, meets that of a planned one."""
    low, high = np.minimum(cylinder.start, cylinder.end) - _REACH, np.maximum(cylinder.start, cylinder.end) + _REACH
    return [
        index
        for index, other in enumerate(found)
        if (np.maximum(other.cylinder.start, other.cylinder.end) >= low).all()
        and (np.minimum(other.cylinder.start, other.cylinder.end) <= high).all()
    ]


def _pair(row: int, column: int, planned: PlannedPipe, found: FoundPipe) -> _Pair | None:
    """Where a measured pipe runs beside a planned one of its size, None where it does not."""
    ours, theirs = planned.cylinder, found.cylinder
    if found.class_name != planned.class_name and (
        found.class_name or abs(theirs.radius - ours.radius) > _SAME_SIZE * ours.radius
    ):
        return None
    if abs(float(ours.axis @ theirs.axis)) < _PARALLEL:
        return None
    first, last = sorted(float(at) for at in ours.along(np.array([theirs.start, theirs.end])))
    low, high = max(first, 0.0), min(last, ours.length)
    if high - low < _OVERLAP * min(ours.length, theirs.length):
        return None
    ends = np.array([ours.start + low * ours.axis, ours.start + high * ours.axis])
    on_found = sorted(float(at) for at in theirs.along(ends))
    across = float(np.linalg.norm(theirs.from_axis(ends), axis=1).max())
    if across > _REACH:
        return None
    return _Pair(row, column, (first, last), (low, high), (on_found[0], on_found[1]), across)


def _common(one: tuple[float, float], other: tuple[float, float]) -> float:
    return max(0.0, min(one[1], other[1]) - max(one[0], other[0]))


def _state(
    row: int, planned: Sequence[PlannedPipe], taken: Sequence[_Pair], found: Sequence[FoundPipe]
) -> PlannedState:
    """The state of the planned pipe `row`, by the pairs of all."""
    one, pairs = planned[row], sorted((pair for pair in taken if pair.planned == row), key=lambda pair: pair.beside)
    if not pairs:
        return PlannedState(one, (), 0.0, 0.0, 0.0)
    length = min(sum(pair.beside[1] - pair.beside[0] for pair in pairs), one.cylinder.length)
    ids, stretches = tuple(found[pair.found].id for pair in pairs), tuple(pair.beside for pair in pairs)
    across, along = max(pair.across for pair in pairs), _along(one.cylinder, pairs, planned, taken)
    return PlannedState(one, ids, length, across, along, stretches)


def _along(own: Cylinder, pairs: Sequence[_Pair], planned: Sequence[PlannedPipe], taken: Sequence[_Pair]) -> float:
    """The shift of a planned pipe along its axis [m]: what both ends are off by the same way, 0 where they are not.

    A pipe hidden at one end tells none, nor does one measured as one with the next: its end there is the next one's.
    """
    first, last = min(pairs, key=lambda pair: pair.on_planned[0]), max(pairs, key=lambda pair: pair.on_planned[1])
    for pair, outwards in ((first, -own.axis), (last, own.axis)):
        next_ones = [planned[other.planned].cylinder.middle for other in taken if other.found == pair.found]
        if any((middle - own.middle) @ outwards > 0.0 for middle in next_ones):
            return 0.0
    at_start, at_end = first.on_planned[0], last.on_planned[1] - own.length
    return min(at_start, at_end, key=abs) if at_start * at_end > 0.0 else 0.0
