# SPDX-License-Identifier: Apache-2.0
"""A plan and its classes as every reader gives them, whatever the kind of the file."""

from __future__ import annotations

from dataclasses import dataclass

from pipeprog_camera.arrays import FloatArray

# m; outer radii nearer to each other are not told apart: three standard deviations of a measured one, 0.1 mm each.
LEAST_RADIUS_STEP = 3e-4


@dataclass(frozen=True)
class Segment:
    """A planned straight pipe.

    Attributes:
        id: its GUID in the plan.
        name: as people know it.
        start, end: of its axis, (3,) [m], in the plan's coordinates.
    """

    id: str
    name: str
    start: FloatArray
    end: FloatArray


@dataclass(frozen=True)
class Entry:
    """An entry of a bill of quantities, not checked yet.

    Attributes:
        where: the file and the place in it, for errors.
        values: what it says, by the keys of BOQ.yaml (docs/files.md); whatever the file holds where a mapping belongs.
        segments: the planned pipes that it sums up, where the plan has their places.
    """

    where: str
    values: object
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What a file of a plan holds: its entries, and sentences for the user on what of it counts, or does not."""

    entries: list[Entry]
    notes: tuple[str, ...] = ()
