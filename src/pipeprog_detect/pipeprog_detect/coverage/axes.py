# SPDX-License-Identifier: Apache-2.0
"""Which parts of pipes' axes were in view: metres by `Sight`, of pipes that are there or that should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.coverage.places import Sight, sights
from pipeprog_detect.types import Cylinder, View

# Distance [m] between the places looked at along an axis: that of `free_space`, twice, since metres are asked for.
STEP = 0.02


@dataclass(frozen=True)
class AxisCoverage:
    """What the keyframes tell of an axis: a `Sight` for each of N equal parts of its length [m]."""

    length: float
    parts: NDArray[np.int8]

    def metres(self, *wanted: Sight, within: NDArray[np.bool_] | None = None) -> float:
        """Metres of these sights; `within` (N,) leaves the other parts out."""
        chosen = np.isin(self.parts, wanted)
        return float((chosen if within is None else chosen & within).mean()) * self.length

    def positions(self) -> FloatArray:
        """Middles (N,) of the parts along the axis, from its start [m]."""
        return np.asarray((np.arange(len(self.parts)) + 0.5) * (self.length / len(self.parts)), np.float64)


def axis_coverage(cylinders: Sequence[Cylinder], views: Sequence[View]) -> list[AxisCoverage]:
    """The coverage of each cylinder's axis by keyframes with depths (`occlusion.with_depths`)."""
    if not cylinders:
        return []
    counts = [max(int(np.ceil(cylinder.length / STEP)), 1) for cylinder in cylinders]
    places = np.concatenate(
        [cylinder.at((np.arange(n) + 0.5) / n) for cylinder, n in zip(cylinders, counts, strict=True)]
    )
    told = sights(places, np.repeat([cylinder.radius for cylinder in cylinders], counts), views)
    parts = np.split(told, np.cumsum(counts)[:-1])
    return [AxisCoverage(cylinder.length, own) for cylinder, own in zip(cylinders, parts, strict=True)]
