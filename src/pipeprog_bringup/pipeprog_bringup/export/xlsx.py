# SPDX-License-Identifier: Apache-2.0
"""A workbook: sheets Progress, Pipes, Planned, Not seen, TASK; numbers are numbers, so every locale shows its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.export.survey import BillLineRow, Survey, SurveyPipe
from pipeprog_bringup.export.tables import activity_shares, class_rows, line_lengths, positive
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import PlannedState

# What a workbook says of when it was made; a fixed day, so that the same results give the same bytes.
_CREATED = datetime(2000, 1, 1)
_METRES, _MILLIMETRES, _PERCENT, _WHOLE, _TEXT = "0.000", "0.00", "0.0%", "0", "@"


@dataclass(frozen=True)
class _Column:
    """Heading, number format, width in characters."""

    heading: str
    format: str = _TEXT
    width: int = 12


_PROGRESS = (
    _Column("Class", width=28),
    _Column("Outer radius [mm]", _MILLIMETRES, 17),
    _Column("Planned [m]", _METRES),
    _Column("Installed [m]", _METRES, 13),
    _Column("Standard deviation [m]", _METRES, 22),
    _Column("Installed [%]", _PERCENT, 13),
    _Column("Pipes", _WHOLE, 8),
    *(_Column(heading) for heading in ("System", "Zone", "Activity", "Start", "Finish", "Material")),
)
_PIPES = (
    _Column("Pipe", width=8),
    _Column("Class", width=28),
    _Column("Run", width=8),
    _Column("Outer radius [mm]", _MILLIMETRES, 17),
    _Column("Radius: standard deviation [mm]", _MILLIMETRES, 30),
    _Column("Length [m]", _METRES),
    _Column("Length: standard deviation [m]", _METRES, 30),
    *(_Column(f"{end} {axis} [m]", _METRES) for end in ("Start", "End") for axis in "xyz"),
    _Column("Probability of the class", _PERCENT, 22),
    _Column("Visible arc [deg]", _WHOLE, 16),
    _Column("Points", _WHOLE),
    _Column("Material seen", width=16),
    _Column("Probability of the material", _PERCENT, 26),
)
_PLANNED = (
    _Column("Planned pipe", width=28),
    _Column("Class", width=28),
    _Column("State", width=12),
    _Column("Planned [m]", _METRES),
    _Column("Installed [m]", _METRES, 13),
    _Column("Off the axis [mm]", _MILLIMETRES, 17),
    _Column("Shifted along [mm]", _MILLIMETRES, 18),
    _Column("Found as", width=16),
    _Column("GUID in the plan", width=26),
)
_NOT_SEEN = (
    _Column("Planned pipe", width=28),
    _Column("Class", width=28),
    _Column("Planned [m]", _METRES),
    *(_Column(f"{end} {axis} [m]", _METRES) for end in ("Start", "End") for axis in "xyz"),
    _Column("GUID in the plan", width=26),
)
_HIDDEN = (_Column("Hidden [m]", _METRES), _Column("Out of view [m]", _METRES, 15))
# Field names of Primavera P6's spreadsheets, which take the first row, and the captions in the second.
_TASK = (_Column("task_code", width=20), _Column("phys_complete_pct", "0.0", 20))
_TASK_CAPTIONS = ("Activity ID", "Physical % Complete")


def write_xlsx(survey: Survey, path: Path) -> None:
    """Writes the workbook; Planned and Not seen need places in the plan, TASK activities in the bill."""
    import xlsxwriter

    book = xlsxwriter.Workbook(str(path), {"strings_to_formulas": False, "strings_to_urls": False})
    book.set_properties({"title": f"pipeprog: {survey.recording}", "created": _CREATED})
    progress = _progress_rows(survey)
    sheet = _write_sheet(book, "Progress", _PROGRESS, progress)
    if progress:
        sheet.conditional_format(
            1,
            5,
            len(progress),
            5,
            {"type": "data_bar", "min_type": "num", "min_value": 0, "max_type": "num", "max_value": 1},
        )
    _write_sheet(book, "Pipes", _PIPES, [_pipe_row(pipe) for pipe in survey.pipes])
    if survey.planned:
        _write_sheet(book, "Planned", _PLANNED, [_planned_row(state) for state in survey.planned])
        _write_sheet(book, "Not seen", *_not_seen(survey))
    shares = activity_shares(survey)
    if shares:
        rows: list[list[Any]] = [[name, 100.0 * share] for name, share in sorted(shares.items())]
        _write_sheet(book, "TASK", _TASK, [list(_TASK_CAPTIONS), *rows])
    book.close()


def _progress_rows(survey: Survey) -> list[list[Any]]:
    """A row for each class; where it has several lines, a row for each of them below it."""
    rows: list[list[Any]] = []
    for row in class_rows(survey):
        alone = len(row.lines) == 1
        cells = [row.name, 1e3 * row.outer_radius, row.planned, row.installed, row.sigma, row.share, row.pipes]
        rows.append([*cells, *(_details(row.lines[0]) if alone else [])])
        if not alone:
            rows += [
                [f"  {line.name}", None, line.planned, length, None, None, None, *_details(line)]
                for line, length in zip(row.lines, line_lengths(survey, row), strict=True)
            ]
    return rows


def _details(line: BillLineRow) -> list[str]:
    return [line.system, line.zone, line.activity, line.start, line.finish, line.material]


def _pipe_row(pipe: SurveyPipe) -> list[Any]:
    cylinder, row = pipe.cylinder, pipe.row
    return [
        pipe.id,
        pipe.class_name,
        pipe.run,
        1e3 * cylinder.radius,
        _scaled(positive(row.get("radius_sigma")), 1e3),
        cylinder.length,
        positive(row.get("length_sigma")),
        *map(float, (*cylinder.start, *cylinder.end)),
        row.get("class_probability"),
        row.get("visible_arc_deg"),
        row.get("points"),
        row.get("material"),
        row.get("material_probability"),
    ]


def _planned_row(state: PlannedState) -> list[Any]:
    planned = state.planned
    off: list[float | None] = [1e3 * state.across, 1e3 * state.along] if state.found else [None] * 2
    cells = [planned.name, planned.class_name, state.state, planned.cylinder.length, state.length, *off]
    return [*cells, ", ".join(state.found), planned.id]


def _not_seen(survey: Survey) -> tuple[Sequence[_Column], list[list[Any]]]:
    """Columns and rows of the planned pipes that were not seen whole; without a coverage, of those not found."""
    coverage = {row["id"]: row for row in survey.results.planned}
    if not coverage:
        return _NOT_SEEN, [_not_seen_row(state.planned) for state in survey.planned if not state.found]
    rows = []
    for state in survey.planned:
        own = coverage.get(state.planned.id)
        if own is not None and own["hidden_m"] + own["not_seen_m"] > 0:
            rows.append([*_not_seen_row(state.planned), own["hidden_m"], own["not_seen_m"]])
    return (*_NOT_SEEN, *_HIDDEN), rows


def _not_seen_row(planned: PlannedPipe) -> list[Any]:
    place = map(float, (*planned.cylinder.start, *planned.cylinder.end))
    return [planned.name, planned.class_name, planned.cylinder.length, *place, planned.id]


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _write_sheet(book: Any, name: str, columns: Sequence[_Column], rows: Sequence[Sequence[Any]]) -> Any:
    """A sheet with its headings, which stay in sight, and the cells below them; None leaves a cell empty."""
    sheet = book.add_worksheet(name)
    bold = book.add_format({"bold": True})
    formats = {format: book.add_format({"num_format": format}) for format in {column.format for column in columns}}
    for index, column in enumerate(columns):
        sheet.set_column(index, index, column.width)
        sheet.write_string(0, index, column.heading, bold)
    sheet.freeze_panes(1, 1)
    for number, row in enumerate(rows, 1):
        for index, cell in enumerate(row):
            if isinstance(cell, str) and cell:
                sheet.write_string(number, index, cell)
            elif isinstance(cell, int | float) and np.isfinite(cell):
                sheet.write_number(number, index, cell, formats[columns[index].format])
    return sheet
