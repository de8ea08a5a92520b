# SPDX-License-Identifier: Apache-2.0
"""What a fleet's surveys found: one row a recording, as fleet.csv, fleet.xlsx and index.html."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any

import xlsxwriter
from jinja2 import Environment, StrictUndefined

from pipeprog_bringup.fleet.recordings import Recording
from pipeprog_bringup.fleet.storage import Place
from pipeprog_bringup.fleet.task import Outcome
from pipeprog_bringup.report import plots
from pipeprog_bringup.report.survey_reader import Survey, read_survey
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import for_spreadsheet

PAGE, TABLE, WORKBOOK = "index.html", "fleet.csv", "fleet.xlsx"
_READ = ("pipes.json", "config.yaml", "trajectory.tum", "run.json")
_FIRST_COLUMNS = ("recording", "state", "reason", "date", "scale_source", "scale_sigma_percent", "pipes")
_LAST_COLUMNS = ("warnings", "address", "report")


@dataclass(frozen=True)
class Row:
    """A recording, what became of it, and its survey where there is one."""

    recording: Recording
    state: str
    reason: str
    survey: Survey | None

    @property
    def warnings(self) -> list[str]:
        """What the numbers of the survey must be read with, one sentence each."""
        if self.survey is None:
            return []
        facts = self.survey.facts
        lost = facts.get("keyframes", 0) - facts.get("registered", 0)
        unregistered = [f"{lost} of {facts['keyframes']} keyframes have no place in the map"] if lost > 0 else []
        return [*map(str, facts.get("warnings", [])), *map(str, facts.get("losses", [])), *unregistered]

    def metres(self, name: str) -> tuple[float | None, float | None]:
        """Installed metres of a class and their standard deviation, None where not known."""
        entries = self.survey.classes if self.survey else []
        entry = next((entry for entry in entries if entry["class"] == name), {})
        return entry.get("installed_m"), entry.get("installed_sigma_m")


def rows_of(place: Place, recordings: Sequence[Recording], outcomes: dict[str, Outcome]) -> list[Row]:
    """A row for each recording, in the order given; results that cannot be read are `failed` with the reason."""
    done = {name for name, outcome in outcomes.items() if outcome.state in ("done", "kept")}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(place.path()) if place.is_local else Path(folder)
        if not place.is_local:
            for name, content in place.read_all([f"{one}/{file}" for one in sorted(done) for file in _READ]).items():
                (home / name).parent.mkdir(exist_ok=True)
                (home / name).write_bytes(content)
        return [_row(home / one.name, one, outcomes[one.name]) for one in recordings]


def write_summary(place: Place, rows: Sequence[Row]) -> None:
    """The three files."""
    classes = list(dict.fromkeys(str(c["class"]) for row in rows if row.survey for c in row.survey.classes))
    table = list(_table(rows, classes))
    place.write(TABLE, _csv(table))
    place.write(WORKBOOK, _workbook(table, list(_site_table(rows, classes))))
    place.write(PAGE, _page(rows, classes).encode("utf-8", errors="replace"))


def sites(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The surveyed rows of each reference that several share, in the order of their dates."""
    found: dict[str, list[tuple[datetime, str, Row]]] = {}
    for row in rows:
        if row.survey is not None:
            site = row.recording.inputs.reference or row.recording.name
            found.setdefault(site, []).append((row.survey.time, row.recording.name, row))
    return {name: [row for _, _, row in sorted(dated)] for name, dated in found.items() if len(dated) > 1}


def _row(folder: Path, recording: Recording, outcome: Outcome) -> Row:
    if outcome.state not in ("done", "kept"):
        return Row(recording, outcome.state, outcome.reason, None)
    try:
        return Row(recording, outcome.state, "", read_survey(folder))
    except (InputError, OSError) as error:
        return Row(recording, "failed", f"its results cannot be read: {error}", None)


def _table(rows: Sequence[Row], classes: Sequence[str]) -> Iterator[list[Any]]:
    """Heading and rows, of texts, numbers and None."""
    metres = [f"{name} {what}" for name in classes for what in ("installed_m", "sigma_m")]
    yield [*_FIRST_COLUMNS, *metres, *_LAST_COLUMNS]
    for row in rows:
        survey = row.survey
        facts: list[Any] = [None] * 4
        if survey is not None:
            sigma = survey.scale.get("sigma")
            percent = None if sigma is None else round(100 * float(sigma), 4)
            facts = [f"{survey.time:%Y-%m-%d %H:%M}", survey.scale.get("source"), percent, len(survey.pipes)]
        numbers = [number for name in classes for number in row.metres(name)]
        link = f"{row.recording.name}/report.html" if survey is not None else None
        first = [row.recording.name, row.state, row.reason or None, *facts]
        yield [*first, *numbers, "; ".join(row.warnings) or None, row.recording.uri, link]


def _site_table(rows: Sequence[Row], classes: Sequence[str]) -> Iterator[list[Any]]:
    yield ["site", "recording", "date", "class", "installed_m", "sigma_m"]
    for site, group in sites(rows).items():
        for row in group:
            assert row.survey is not None
            for name in classes:
                if row.metres(name)[0] is not None:
                    yield [site, row.recording.name, f"{row.survey.time:%Y-%m-%d %H:%M}", name, *row.metres(name)]


def _csv(table: Sequence[Sequence[Any]]) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    for cells in table:
        writer.writerow([for_spreadsheet(cell) if isinstance(cell, str) else cell for cell in cells])
    return stream.getvalue().encode("utf-8", errors="replace")


def _workbook(recordings: Sequence[Sequence[Any]], over_time: Sequence[Sequence[Any]]) -> bytes:
    """Numbers as numbers, texts as texts, whatever the language of the spreadsheet."""
    stream = io.BytesIO()
    with xlsxwriter.Workbook(
        stream, {"in_memory": True, "strings_to_formulas": False, "strings_to_urls": False}
    ) as book:
        heading = book.add_format({"bold": True})
        for name, table in (("Recordings", recordings), ("Sites", over_time)):
            sheet = book.add_worksheet(name)
            sheet.freeze_panes(1, 1)
            sheet.set_column(0, 0, 24)  # characters; a name of robot and date
            for row, cells in enumerate(table):
                for column, cell in enumerate(cells):
                    if cell is not None:
                        sheet.write(row, column, cell, heading if row == 0 else None)
    return stream.getvalue()


def _page(rows: Sequence[Row], classes: Sequence[str]) -> str:
    """index.html beside this module, filled; what is put into it is escaped but the plots, which are our own."""
    source = resources.files(__package__).joinpath(PAGE).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    counts = {state: sum(row.state == state for row in rows) for state in ("done", "kept", "refused", "failed")}
    groups = [
        {"name": name, "rows": group, "plot": plots.svg(plots.series([row.survey for row in group if row.survey]))}
        for name, group in sites(rows).items()
    ]
    return environment.from_string(source).render(rows=rows, classes=classes, counts=counts, sites=groups)
