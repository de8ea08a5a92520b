# SPDX-License-Identifier: Apache-2.0
"""What makes a model metric: its scale and the frame `map`, from all sources of scale and of the vertical."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

from pipeprog_sfm.metric.map_frame import Vertical, map_from_model
from pipeprog_sfm.metric.scale import (
    Combined,
    NoScaleError,
    PoseCovariance,
    ScaleEstimate,
    ScaleWarning,
    combine,
)
from pipeprog_sfm.metric.scale_evidence import PosedEvidence
from pipeprog_sfm.metric.scale_sources import SOURCES, ScaleSource
from pipeprog_sfm.metric.vertical_from_planes import PlanesError
from pipeprog_sfm.metric.vertical_sources import VERTICAL_SOURCES, floor_and_walls

Found = TypeVar("Found")


def estimate_scale(
    posed: PosedEvidence, covariance: PoseCovariance | None = None, sources: Sequence[ScaleSource] = SOURCES
) -> ScaleEstimate:
    """Metric scale and map frame of a model.

    Args:
        posed: what tells the scale and the vertical, with the poses.
        covariance: of functions of the poses; None takes these for exact.
        sources: what measures the scale, in the order in which it is reported.

    Raises:
        NoScaleError: no source measures the scale, or not well enough, or nothing tells the vertical.
    """
    measurements, warnings = _sorted(found for source in sources for found in source(posed))
    if not measurements:
        raise _no_scale(posed, warnings)
    combined = combine(measurements, posed.poses, covariance)
    verticals, doubts = _verticals(posed, combined)
    boards = posed.boards.sound
    frame, description, disagreements = map_from_model(
        combined.scale, boards[0] if boards else None, verticals, posed.poses
    )
    return ScaleEstimate(
        combined.scale,
        combined.sigma,
        "+".join(dict.fromkeys(one.source for one in measurements)),
        tuple(sorted({view.stamp for place in boards for view in place.views})),
        frame,
        description,
        boards,
        tuple(measurements),
        (*(warning.text for warning in [*warnings, *doubts]), *combined.warnings, *disagreements),
    )


def _sorted(found: Iterable[Found | ScaleWarning]) -> tuple[list[Found], list[ScaleWarning]]:
    """What was found, and the warnings."""
    results: list[Found] = []
    warnings: list[ScaleWarning] = []
    for each in found:
        if isinstance(each, ScaleWarning):
            warnings.append(each)
        else:
            results.append(each)
    return results, warnings


def _no_scale(posed: PosedEvidence, warnings: Sequence[ScaleWarning]) -> NoScaleError:
    """The error for want of any measurement: the reason of the first warning that has one, and all texts."""
    nothing = "nothing tells the scale: hang up a board and name its file, or record odometry"
    texts = [nothing] * (not posed.seen.board_file.boards) + [warning.text for warning in warnings]
    return NoScaleError(next((one.reason for one in warnings if one.reason), "no_board"), "; ".join(texts))


def _verticals(posed: PosedEvidence, combined: Combined) -> tuple[list[Vertical], list[ScaleWarning]]:
    """At least one vertical, the best first, and warnings; raises NoScaleError where nothing tells it."""
    found: Iterable[Vertical | ScaleWarning] = (
        one for source in VERTICAL_SOURCES for one in source(posed, combined.scale)
    )
    verticals, warnings = _sorted(found)
    if not verticals:
        try:
            verticals = [floor_and_walls(posed)]
        except PlanesError as error:
            raise NoScaleError(
                "no_vertical", f"{error}: hang the board upright and set upright to true, or record an IMU or odometry"
            ) from error
    return verticals, warnings
