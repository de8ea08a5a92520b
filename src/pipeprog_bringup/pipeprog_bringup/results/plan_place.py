# SPDX-License-Identifier: Apache-2.0
"""Whether a plan that has places lies where the survey is; where it does not, no planned pipe can be found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.product.boq import PlannedPipe

# m; what was filmed may end in a room beside the planned pipes, but coordinates of a site begin kilometres away.
_BESIDE = 10.0
_STRAY = 0.01  # of the points, on each side: a cloud has some far from all surfaces


def why_no_place_is_planned(planned: Sequence[PlannedPipe], points: NDArray[np.floating], remedy: str) -> list[str]:
    """A sentence with the remedy where no planned pipe lies within or near the survey; none otherwise.

    points (N, 3): surfaces or places that the survey has, in the coordinates in which it is compared [m].
    """
    if not planned or not len(points):
        return []
    low, high = np.quantile(points, (_STRAY, 1.0 - _STRAY), axis=0)
    ends = np.array([[pipe.cylinder.start, pipe.cylinder.end] for pipe in planned])
    gaps = np.maximum(0.0, np.maximum(low - ends.max(axis=1), ends.min(axis=1) - high))
    away = float(np.linalg.norm(gaps, axis=1).min())
    if away <= _BESIDE:
        return []
    distance = f"{away:.0f} m" if away < 1000.0 else f"{1e-3 * away:.0f} km"
    return [f"the plan lies {distance} away from the survey, so no pipe is found where it is planned: {remedy}"]
