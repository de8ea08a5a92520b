# SPDX-License-Identifier: Apache-2.0
"""Two surveys of one site, in one frame: which pipes were kept, are longer, shorter, new, gone, or were not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_detect.coverage.axes import STEP, AxisCoverage, axis_coverage
from pipeprog_detect.coverage.places import Sight
from pipeprog_detect.types import Cylinder, View

# Axes of one pipe lie within the larger of its radius and this [m], ...
NEAR = 0.02
# ... and what two maps in the frame of one board are apart, as a standard deviation [m]: a board of 0.6 m with circles
# placed to 0.1 mm turns its frame by 0.3 mrad, which is 3 mm ten metres away.
ALIGNMENT = 0.003
PARALLEL = float(np.cos(np.radians(3.0)))
OVERLAP = 0.3  # of the shorter one
SIGMAS = 3.0  # of an end in both surveys, by which a pipe is longer or shorter there
UNKNOWN_SIGMA = 0.007  # m, of an end whose sigma is not known: a centimetre at both ends together
STATES = ("kept", "longer", "shorter", "new", "gone", "not_seen")


@dataclass(frozen=True)
class KnownPipe:
    """A pipe of a survey: its id, place, class (empty without one) and the standard deviations of its ends [m]."""

    id: str
    cylinder: Cylinder
    class_name: str
    end_sigmas: tuple[float, float] = (UNKNOWN_SIGMA, UNKNOWN_SIGMA)


@dataclass(frozen=True)
class Change:
    """What became of a pipe.

    Attributes:
        state: one of STATES; `gone` and `shorter` only where the keyframes see through what is gone.
        class_name: empty without one.
        before, after: ids of its pieces in the two surveys.
        length_before, length_after: of these together [m].
        counted: metres that count as installed now: what is measured, and of what was there before all that nobody has
            seen to be gone.
        grown: metres by which it has become longer or, negative, shorter at those of its ends that have moved by more
            than their standard deviations: an end that is hidden in both surveys is measured elsewhere in each.
    """

    state: str
    class_name: str
    before: tuple[str, ...]
    after: tuple[str, ...]
    length_before: float
    length_after: float
    counted: float
    grown: float


def changes(before: Sequence[KnownPipe], after: Sequence[KnownPipe], views: Sequence[View]) -> list[Change]:
    """Changes of the pipes before, in their order, then the new ones.

    `views` with depths are those of the survey after. Each pipe after is a piece of one pipe before at most: of the one
    that it runs beside for longest.
    """
    pieces: dict[int, list[int]] = {}
    new = []
    for number, pipe in enumerate(after):
        shared = [_shared(old, pipe) for old in before]
        if shared and max(shared) > 0.0:
            pieces.setdefault(int(np.argmax(shared)), []).append(number)
        else:
            length = pipe.cylinder.length
            new.append(Change("new", pipe.class_name, (), (pipe.id,), 0.0, length, counted=length, grown=length))
    coverage = axis_coverage([pipe.cylinder for pipe in before], views)
    known = [
        _known(old, [after[piece] for piece in pieces.get(number, [])], own)
        for number, (old, own) in enumerate(zip(before, coverage, strict=True))
    ]
    return known + new


def _shared(old: KnownPipe, new: KnownPipe) -> float:
    """Length [m] along which two pipes are one; 0 where they are not."""
    ours, theirs = old.cylinder, new.cylinder
    if old.class_name != new.class_name or abs(float(ours.axis @ theirs.axis)) < PARALLEL:
        return 0.0
    low, high = sorted(float(at) for at in ours.along(np.stack([theirs.start, theirs.end])))
    low, high = max(low, 0.0), min(high, ours.length)
    if high - low < OVERLAP * min(ours.length, theirs.length):
        return 0.0
    ends = ours.at(np.array([low, high]) / ours.length)
    apart = float(np.linalg.norm(theirs.from_axis(ends), axis=1).max())
    return high - low if apart <= max(ours.radius, NEAR) + SIGMAS * ALIGNMENT else 0.0


def _known(old: KnownPipe, pieces: Sequence[KnownPipe], own: AxisCoverage) -> Change:
    """The change of a pipe that was there before, of which `own` is what the survey after tells of its axis."""
    length, now = old.cylinder.length, math.fsum(piece.cylinder.length for piece in pieces)
    ids = tuple(piece.id for piece in pieces)
    if not pieces:
        gone = own.metres(Sight.EMPTY) > 0.5 * length
        counted = 0.0 if gone else length
        state = "gone" if gone else "not_seen"
        return Change(state, old.class_name, (old.id,), ids, length, now, counted, counted - length)
    is_shorter = is_longer = False
    counted, grown = now, 0.0
    stretches = _open_stretches(old, pieces)
    for number, stretch in enumerate(stretches):
        beyond = (own.positions() > stretch.low) & (own.positions() < stretch.high)
        vanished = own.metres(Sight.EMPTY, within=beyond)
        unseen = own.metres(*Sight, within=beyond) - vanished
        least = SIGMAS * float(np.linalg.norm(stretch.sigmas)) + STEP
        if vanished > least:
            is_shorter, grown = True, grown - (stretch.high - stretch.low - unseen)
        elif number in (0, len(stretches) - 1) and stretch.low - stretch.high > least:
            is_longer, grown = True, grown + stretch.low - stretch.high
        # Of a stretch that nobody has seen to be gone, the survey tells that knows the end better.
        counted += unseen if unseen > SIGMAS * min(stretch.sigmas) + STEP else 0.0
    state = "shorter" if is_shorter else "longer" if is_longer else "kept"
    return Change(state, old.class_name, (old.id,), ids, length, now, counted, grown)


@dataclass(frozen=True)
class _Stretch:
    """From `low` to `high` [m] along a known axis nothing is measured now; `high` below `low` where the pipe has grown.

    `sigmas`: of both limits [m].
    """

    low: float
    high: float
    sigmas: tuple[float, float]


def _open_stretches(old: KnownPipe, pieces: Sequence[KnownPipe]) -> list[_Stretch]:
    """What the pieces leave open of a pipe: before the first, between two, and after the last."""
    spans = []
    for piece in pieces:
        along = old.cylinder.along(np.stack([piece.cylinder.start, piece.cylinder.end])).tolist()
        spans.append(sorted(zip(along, piece.end_sigmas, strict=True)))
    spans.sort()
    lows = [(0.0, old.end_sigmas[0]), *(span[1] for span in spans)]
    highs = [*(span[0] for span in spans), (old.cylinder.length, old.end_sigmas[1])]
    return [_Stretch(low, high, (one, other)) for (low, one), (high, other) in zip(lows, highs, strict=True)]
