# SPDX-License-Identifier: Apache-2.0
"""What the client of a survey is told to do."""

from __future__ import annotations

Place = tuple[float, float, float]


def advice(missing: str, is_lost: bool, last_known: Place | None, problem: str) -> str:
    """One sentence; empty where all is well.

    The first of these that applies: input that is missing, because nothing else can be mended without it; tracking
    that is lost, because what is filmed meanwhile is not used; the problem of the map.

    Args:
        missing: which input does not come, and the remedy.
        is_lost: whether the survey is filmed and the last keyframes have no place in the map.
        last_known: where the camera was last located, m in the frame `map`; None: it has not been located.
        problem: that the map is full, or the message of SfmStatus.
    """
    return missing or (_way_back(last_known) if is_lost else "") or problem


def _way_back(last_known: Place | None) -> str:
    if last_known is None:
        return "tracking is lost: walk back the way you came, until tracking returns"
    x, y, z = last_known
    return (
        f"tracking is lost: walk back to x {x:.1f} m, y {y:.1f} m, z {z:.1f} m in the frame map, "
        "where the camera was last located, and film there until tracking returns"
    )
