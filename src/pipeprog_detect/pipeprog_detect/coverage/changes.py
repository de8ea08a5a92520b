# SPDX-License-Identifier: Apache-2.0
"""Two surveys of one site, in one frame: which pipes were kept, are longer, shorter, new, gone, or were not seen."""

from __future__ import annotations

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
SIGMAS = 3.0  # of both lengths, by which a pipe is longer or shorter
UNKNOWN_SIGMA = 0.01  # m, of a length whose sigma is not known: a centimetre at both ends together
STATES = ("kept", "longer", "shorter", "new", "gone", "not_seen")


@dataclass(frozen=True)
class KnownPipe:
    """A pipe of a survey: its id, place, class (empty without one) and the standard deviation of its length [m]."""

    id: str
    cylinder: Cylinder
    class_name: str
    sigma: float | None = None


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
    """

    state: str
    class_name: str
    before: tuple[str, ...]
    after: tuple[str, ...]
    length_before: float
    length_after: float
    counted: float


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
            new.append(Change("new", pipe.class_name, (), (pipe.id,), 0.0, pipe.cylinder.length, pipe.cylinder.length))
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
    length, now = old.cylinder.length, sum(piece.cylinder.length for piece in pieces)
    left = np.ones(len(own.parts), bool)
    for piece in pieces:
        ends = np.stack([piece.cylinder.start, piece.cylinder.end])
        low, high = sorted(float(at) for at in old.cylinder.along(ends))
        left &= (own.positions() < low) | (own.positions() > high)
    vanished = own.metres(Sight.EMPTY, within=left)
    unseen = own.metres(*Sight, within=left) - vanished
    ids = tuple(piece.id for piece in pieces)
    if not pieces:
        gone = vanished > 0.5 * length
        counted = 0.0 if gone else length
        return Change("gone" if gone else "not_seen", old.class_name, (old.id,), ids, length, now, counted)
    sigmas = [UNKNOWN_SIGMA if one.sigma is None else one.sigma for one in (old, *pieces)]
    least = SIGMAS * float(np.linalg.norm(sigmas)) + STEP
    added = now - (length - vanished - unseen)
    state = "shorter" if vanished > least else "longer" if added > least else "kept"
    return Change(state, old.class_name, (old.id,), ids, length, now, now + (unseen if unseen > least else 0.0))
