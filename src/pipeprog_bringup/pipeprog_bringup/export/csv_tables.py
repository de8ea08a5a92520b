# SPDX-License-Identifier: Apache-2.0
"""CSV files that spreadsheets of every locale read rightly: whole numbers, in units small enough.

A decimal point is that of thousands in half of Europe, and `1.906` becomes 1906 without a word; digits alone mean the
same everywhere. The header names the unit of each column.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from pipeprog_bringup.export.survey import Survey
from pipeprog_bringup.export.tables import class_rows, positive
from pipeprog_bringup.results.pipes_file import COVERAGE_KEYS
from pipeprog_camera.outside_text import for_spreadsheet

CLASS_COLUMNS = (
    *("class", "outer_radius_um", "planned_mm", "installed_mm", "installed_sigma_um", "percent", "pipes"),
    *("missing_mm", "unclear_mm", "hidden_mm", "not_seen_mm", "walls_seen_percent"),
)
PIPE_COLUMNS = (
    *("id", "class", "run", "outer_radius_um", "radius_sigma_um", "length_mm", "length_sigma_um"),
    *("start_x_mm", "start_y_mm", "start_z_mm", "end_x_mm", "end_y_mm", "end_z_mm"),
    *("class_probability_percent", "visible_arc_deg", "points"),
    *("hidden_mm", "not_seen_mm", "material", "material_probability_percent"),
)
_MICRO, _MILLI, _PERCENT = 1e6, 1e3, 100.0


def write_classes(survey: Survey, path: Path) -> None:
    """One line for each class."""
    rows = (
        [
            row.name,
            _whole(row.outer_radius, _MICRO),
            _whole(row.planned, _MILLI),
            _whole(row.installed, _MILLI),
            _whole(row.sigma, _MICRO),
            _whole(row.share, _PERCENT),
            str(row.pipes),
            *(_whole(own.get(key), _MILLI) for key in COVERAGE_KEYS),
            _whole(own.get("walls_seen_percent"), 1.0),
        ]
        for row, own in zip(class_rows(survey), survey.results.classes, strict=True)
    )
    _write(path, CLASS_COLUMNS, rows)


def write_pipes(survey: Survey, path: Path) -> None:
    """One line for each pipe."""
    rows = (
        [
            pipe.id,
            pipe.class_name,
            pipe.run,
            _whole(pipe.cylinder.radius, _MICRO),
            _whole(positive(pipe.row.get("radius_sigma")), _MICRO),
            _whole(pipe.cylinder.length, _MILLI),
            _whole(positive(pipe.row.get("length_sigma")), _MICRO),
            *(_whole(value, _MILLI) for value in (*pipe.cylinder.start, *pipe.cylinder.end)),
            _whole(pipe.row.get("class_probability"), _PERCENT),
            _whole(pipe.row.get("visible_arc_deg"), 1.0),
            _whole(pipe.row.get("points"), 1.0),
            _whole(pipe.row.get("hidden_m"), _MILLI),
            _whole(pipe.row.get("not_seen_m"), _MILLI),
            pipe.row.get("material") or "",
            _whole(pipe.row.get("material_probability"), _PERCENT),
        ]
        for pipe in survey.pipes
    )
    _write(path, PIPE_COLUMNS, rows)


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8-sig") as stream:  # Excel takes UTF-8 only with its mark
        writer = csv.writer(stream, lineterminator="\r\n")
        writer.writerow(columns)
        writer.writerows([_cell(cell) for cell in row] for row in rows)


def _cell(text: str) -> str:
    """Texts that a spreadsheet would take for a formula get an apostrophe; negative numbers stay numbers."""
    return text if text.lstrip("-").isdigit() else for_spreadsheet(text)


def _whole(value: float | None, factor: float) -> str:
    return "" if value is None or not np.isfinite(value) else f"{round(value * factor):d}"
