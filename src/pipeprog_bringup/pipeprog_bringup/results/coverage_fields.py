# SPDX-License-Identifier: Apache-2.0
"""What a survey had in view, as pipes.json and progress.csv hold it; docs/files.md describes the fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeprog_bringup.results.pipes_file import COVERAGE_KEYS
from pipeprog_detect.coverage.axes import AxisCoverage
from pipeprog_detect.coverage.places import Sight
from pipeprog_detect.coverage.planned import PlannedCoverage
from pipeprog_detect.coverage.survey import SurveyCoverage

_METRES = {key: key.removesuffix("_m") for key in COVERAGE_KEYS}  # and the attribute of PlannedCoverage
CLASS_FIELDS = (*COVERAGE_KEYS, "walls_seen_percent")


def of_pipe(own: AxisCoverage) -> dict[str, float]:
    """Fields of a measured pipe: metres of its axis that something hides, and that are out of view."""
    return {"hidden_m": _metres(own.metres(Sight.HIDDEN)), "not_seen_m": _metres(own.metres(Sight.NOT_SEEN))}


def of_classes(names: Sequence[str], coverage: SurveyCoverage) -> list[dict[str, float | None]]:
    """Fields of each class; metres are None where the plan has no places, the percentage where no wall was found."""
    walls, rows = coverage.walls, []
    for number, name in enumerate(names):
        own = [each for each in coverage.planned if each.planned.class_name == name]
        row: dict[str, float | None] = dict.fromkeys(CLASS_FIELDS)
        if coverage.planned:
            for key, attribute in _METRES.items():
                row[key] = _metres(sum(getattr(each, attribute) for each in own))
        if walls.area > 0:
            row["walls_seen_percent"] = round(100 * walls.seen[number] / walls.area, 1)
        rows.append(row)
    return rows


def of_planned(each: PlannedCoverage) -> dict[str, Any]:
    """The row of a planned pipe."""
    planned = each.planned
    return {
        "id": planned.id,
        "name": planned.name,
        "class": planned.class_name,
        "line": planned.line,
        "state": each.word,
        "planned_m": _metres(planned.cylinder.length),
        "installed_m": _metres(each.state.length),
        **{key: _metres(getattr(each, attribute)) for key, attribute in _METRES.items()},
        "pipes": list(each.state.found),
    }


def _metres(value: float) -> float:
    """To the millimetre: places are asked for every two centimetres."""
    return round(value, 3)
