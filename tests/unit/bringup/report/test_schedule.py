# SPDX-License-Identifier: Apache-2.0
"""Lines of the bill against the calendar."""

from __future__ import annotations

from datetime import date, datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeprog_bringup.report.schedule import Line, lines, sentence, zones
from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_bringup.results.results_reader import Results

DAY = datetime(2026, 3, 11, 22, 0, tzinfo=timezone.utc)
HEATING = {"name": "heating", "planned_length_m": 20.0, "zone": "A", "start": "2026-03-01", "finish": "2026-03-21"}
WATER = {"name": "water", "planned_length_m": 10.0, "zone": "B"}


def survey(entries: list[Any], installed: dict[str, float], planned: list[dict[str, Any]] | None = None) -> Survey:
    classes = [{"class": name, "installed_m": length} for name, length in installed.items()]
    config: dict[str, Any] = {"boq": entries}
    none = np.empty(0, np.int64), np.empty((0, 4, 4))
    return Survey("s", DAY, Results(Path(), [], classes, [], planned or [], None, {}, {}, config, *none))


def one(entry: dict[str, Any], installed: float, rates: dict[str, float] | None = None) -> Line:
    (line,) = lines(survey([{"name": "DN100", "lines": [entry]}], {"DN100": installed}), rates or {})
    return line


def test_metres_are_due_evenly_from_start_to_finish() -> None:
    """Ten of twenty days have passed: half of the 20 m is due, and 4 m are there."""
    line = one(HEATING, 4.0)
    assert line.due == pytest.approx(10.0)
    assert line.behind == pytest.approx(6.0)
    assert one(HEATING, 12.0).behind == 0.0


def test_a_line_is_expected_at_its_own_rate_without_a_survey_before() -> None:
    """4 m in ten days: the other 16 m take forty."""
    assert one(HEATING, 4.0).expected == date(2026, 4, 20)


def test_the_rate_since_the_survey_before_counts_for_more() -> None:
    assert one(HEATING, 4.0, {"DN100": 2.0}).expected == date(2026, 3, 19)
    assert one(HEATING, 4.0, {"DN100": 0.0}).expected is None
    assert one(HEATING, 20.0, {"DN100": 2.0}).expected is None


@pytest.mark.parametrize(("day", "due"), [("2026-04-01", 0.0), ("2026-03-12", 0.0), ("2026-03-11", 0.0)])
def test_nothing_is_due_before_the_start(day: str, due: float) -> None:
    assert one({**HEATING, "start": day, "finish": "2026-05-01"}, 0.0).due == due


def test_all_is_due_from_the_finish_on() -> None:
    assert one({**HEATING, "finish": "2026-03-11"}, 4.0).due == 20.0
    assert one({**HEATING, "start": "2026-03-11", "finish": "2026-03-11"}, 4.0).due == 20.0


def test_lines_of_one_size_are_told_apart_by_places_alone() -> None:
    entries = [{"name": "DN100", "lines": [HEATING, WATER]}]
    assert [line.installed for line in lines(survey(entries, {"DN100": 9.0}), {})] == [None, None]
    rows = [
        {"class": "DN100", "line": number, "installed_m": length} for number, length in ((0, 5.0), (1, 3.0), (1, 1.0))
    ]
    found = lines(survey(entries, {"DN100": 9.0}, rows), {})
    assert [line.installed for line in found] == [5.0, 4.0]
    assert [(zone.name, zone.planned, zone.installed) for zone in zones(found)] == [("A", 20.0, 5.0), ("B", 10.0, 4.0)]


def test_a_zone_with_metres_that_cannot_be_told_has_none() -> None:
    found = lines(survey([{"name": "DN100", "lines": [HEATING, WATER]}], {"DN100": 9.0}), {})
    assert [zone.installed for zone in zones(found)] == [None, None]


def test_the_sentence_names_the_line_that_will_be_late() -> None:
    assert sentence([one(HEATING, 4.0)]) == (
        "6.0 m behind schedule; at this rate heating is done on 2026-04-20, planned 2026-03-21"
    )
    assert sentence([one(HEATING, 11.0)]) == "On schedule"
    assert sentence([one(WATER, 4.0)]) == ""


def test_a_bill_without_details_has_no_lines_to_show() -> None:
    plain = [{"name": "DN100"}, {"name": "DN50", "lines": [{"name": "DN50", "planned_length_m": 2.0}]}]
    assert lines(survey(plain, {"DN100": 1.0, "DN50": 1.0}), {}) == []


@pytest.mark.parametrize(
    "damaged", [None, "text", {"planned_length_m": "a"}, {"planned_length_m": True}, {"planned_length_m": -1.0}, {}]
)
def test_entries_that_are_no_lines_are_left_out(damaged: object) -> None:
    found = lines(survey([{"name": "DN100", "lines": [damaged, HEATING]}, "text"], {"DN100": 4.0}), {})
    assert [line.name for line in found] == ["heating"]
    assert one({**HEATING, "start": "soon"}, 4.0).start is None
