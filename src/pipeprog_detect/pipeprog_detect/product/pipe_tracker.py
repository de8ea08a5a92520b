# SPDX-License-Identifier: Apache-2.0
"""The same pipe keeps its name from map to map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from scipy.optimize import linear_sum_assignment

from pipeprog_detect.types import Cylinder, Pipe

# One pipe in two maps: axes nearer than its radius or 20 mm, under 5 degrees, and one beside the other for this share
# of the shorter one. The map moves by less from update to update, racks are 1.3 diameters apart.
_LEAST_OFFSET, _ANGLE, _OVERLAP = 0.02, np.radians(5.0), 0.3


class PipeTracker:
    """Names pipes, map after map; a name is never given to another pipe.

    known: names that are given already, and where each pipe was seen last.
    """

    def __init__(self, known: Mapping[str, Cylinder] = MappingProxyType({})) -> None:
        self._known = dict(known)
        self._last = max((int(name[1:]) for name in known), default=0)

    def named(self, pipes: Sequence[Pipe]) -> list[Pipe]:
        """The pipes in their order, each with the id that it had in an earlier map or with the next free one.

        The first map's pipes are p01, p02, ... in their order. A pipe that a map lacks is remembered.
        """
        names = list(self._known)
        likeness = np.array([[_likeness(pipe.cylinder, self._known[name]) for name in names] for pipe in pipes])
        likeness = likeness.reshape(len(pipes), len(names))
        chosen = {}
        for row, column in zip(*linear_sum_assignment(-likeness), strict=True):
            if likeness[row, column] > 0.0:
                chosen[int(row)] = names[int(column)]
        width = max(2, len(str(self._last + len(pipes) - len(chosen))))
        named = []
        for number, pipe in enumerate(pipes):
            if number not in chosen:
                self._last += 1
                chosen[number] = f"p{self._last:0{width}d}"
            self._known[chosen[number]] = pipe.cylinder
            named.append(replace(pipe, id=chosen[number]))
        return named


def _likeness(one: Cylinder, other: Cylinder) -> float:
    """0 for two pipes that are not one, up to 1 for the same."""
    if abs(float(one.axis @ other.axis)) < np.cos(_ANGLE):
        return 0.0
    place = np.array([(end - other.start) @ other.axis for end in (one.start, one.end)])
    low, high = max(float(place.min()), 0.0), min(float(place.max()), other.length)
    overlap = (high - low) / min(one.length, other.length)
    if overlap < _OVERLAP:
        return 0.0
    middle = other.start + 0.5 * (low + high) * other.axis - one.start
    offset = float(np.linalg.norm(middle - (middle @ one.axis) * one.axis))
    limit = max(other.radius, _LEAST_OFFSET)
    return max(0.0, 1.0 - offset / limit) * min(overlap, 1.0)
