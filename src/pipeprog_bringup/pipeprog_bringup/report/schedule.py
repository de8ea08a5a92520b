# SPDX-License-Identifier: Apache-2.0
"""The lines of the bill against the calendar: metres by zone, metres due, and when a line will be done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import Any

from pipeprog_bringup.report.survey_reader import Survey

DETAILS = ("system", "zone", "activity")  # what tells lines of one size apart
FARTHEST = 3650.0  # days; a rate so small that a line takes ten years tells no date


@dataclass(frozen=True)
class Line:
    """A line of the bill on the day of a survey.

    Attributes:
        class_name: its class, which several lines of one size share.
        name, system, zone, activity: as in the bill; empty where not given.
        planned: metres.
        installed: metres; None where lines share a class and the plan has no places to tell them apart.
        start, finish: planned dates, None where not given.
        due: metres that the dates ask for on that day, evenly from start to finish; None without both.
        expected: date at which the line is done if it goes on as before; None where no rate is known.
    """

    class_name: str
    name: str
    system: str
    zone: str
    activity: str
    planned: float
    installed: float | None
    start: date | None
    finish: date | None
    due: float | None
    expected: date | None

    @property
    def behind(self) -> float | None:
        """Metres that are due and not installed; None where either is not known."""
        return None if self.due is None or self.installed is None else max(self.due - self.installed, 0.0)


@dataclass(frozen=True)
class Zone:
    """Metres of a zone; installed is None where lines of several zones share a class and cannot be told apart."""

    name: str
    planned: float
    installed: float | None


def lines(survey: Survey, rates: Mapping[str, float]) -> list[Line]:
    """The lines of a survey's bill; none where no line says more than its class.

    `rates`: metres a day of each class since the survey before; without one a line's own rate is that since its start.
    """
    found = [
        line
        for entry in survey.results.config.get("boq") or []
        if isinstance(entry, dict) and isinstance(entry.get("lines"), list)
        for line in _lines_of(entry, survey, rates)
    ]
    return found if any(line.zone or line.system or line.activity or line.finish for line in found) else []


def zones(found: Sequence[Line]) -> list[Zone]:
    """The zones of these lines, in their order; none where no line has one."""
    if not any(line.zone for line in found):
        return []
    result = []
    for name in dict.fromkeys(line.zone for line in found):
        own = [line for line in found if line.zone == name]
        known = [line.installed for line in own if line.installed is not None]
        result.append(Zone(name, sum(line.planned for line in own), sum(known) if len(known) == len(own) else None))
    return result


def sentence(found: Sequence[Line]) -> str:
    """How the metres stand against the dates; empty where the bill has none or they cannot be told."""
    behind = [line.behind for line in found if line.behind is not None]
    if not behind:
        return ""
    late = [line for line in found if line.expected and line.finish and line.expected > line.finish]
    told = f"{sum(behind):.1f} m behind schedule" if sum(behind) >= 0.05 else "On schedule"
    if late:
        last = max(late, key=lambda line: line.expected or date.min)
        told += f"; at this rate {last.name} is done on {last.expected}, planned {last.finish}"
    return told


def _lines_of(entry: dict[str, Any], survey: Survey, rates: Mapping[str, float]) -> list[Line]:
    """The lines of a class of config.yaml; entries that are no lines are left out."""
    class_name, day = str(entry.get("name")), survey.time.date()
    given = [
        row for row in entry["lines"] if isinstance(row, dict) and _number(row.get("planned_length_m")) is not None
    ]
    result = []
    for number, row in enumerate(given):
        planned = float(row["planned_length_m"])
        installed = _installed(survey, class_name, number, alone=len(given) == 1)
        start, finish = _day(row.get("start")), _day(row.get("finish"))
        rate = rates.get(class_name) if len(given) == 1 else None
        if rate is None and installed is not None and start is not None and start < day:
            rate = installed / (day - start).days
        system, zone, activity = (str(row.get(key) or "") for key in DETAILS)
        result.append(
            Line(
                class_name=class_name,
                name=str(row.get("name") or class_name),
                system=system,
                zone=zone,
                activity=activity,
                planned=planned,
                installed=installed,
                start=start,
                finish=finish,
                due=_due(planned, start, finish, day),
                expected=_expected(planned, installed, rate, day),
            )
        )
    return result


def _installed(survey: Survey, class_name: str, line: int, alone: bool) -> float | None:
    """Metres of a line: those of its class where it is the only one, else those at the places of its planned pipes."""
    if alone:
        return survey.installed.get(class_name)
    own = [row for row in survey.results.planned if row["class"] == class_name]
    if not own or any("line" not in row for row in own):
        return None
    return sum(float(row["installed_m"]) for row in own if row["line"] == line)


def _due(planned: float, start: date | None, finish: date | None, day: date) -> float | None:
    if start is None or finish is None:
        return None
    if day >= finish:
        return planned
    return planned * max(0, (day - start).days) / (finish - start).days


def _expected(planned: float, installed: float | None, rate: float | None, day: date) -> date | None:
    if installed is None or rate is None or rate <= 0.0 or installed >= planned:
        return None
    days = (planned - installed) / rate
    return day + timedelta(days=round(days)) if days <= FARTHEST else None


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and value > 0 else None


def _day(value: object) -> date | None:
    """A date of config.yaml, which YAML may have read as one."""
    if isinstance(value, date):
        return value
    try:
        return date.fromisoformat(str(value))
    except ValueError:
        return None
