# SPDX-License-Identifier: Apache-2.0
"""Results whose plan has places: what is installed where, in the workbook."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from openpyxl import load_workbook

from pipeprog_bringup.export.control_points import Alignment
from pipeprog_bringup.export.formats import export, plan_notes
from pipeprog_bringup.export.survey import Site
from pipeprog_bringup.results.plan_file import read_plan, write_plan
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.types import Cylinder
from tests.unit.bringup.export.conftest import BOTH, PIPES

NO_LENGTH = '{"id": "a", "name": "b", "class": "c", "line": 0, "start": [0, 0, 0], "end": [0, 0, 0], "radius": 1}'


def test_the_workbook_tells_what_is_installed_where_planned(folder: Path, tmp_path: Path) -> None:
    moved = PIPES[2].cylinder.shifted(np.array([0, 0.04, 0]))
    planned = [
        PlannedPipe("guid-1", "riser", PIPES[0].cylinder, "=DN65", 0),
        PlannedPipe("guid-2", "sprinkler 7", moved, BOTH, 1),
        PlannedPipe("guid-3", "heating 3", Cylinder(np.array([5.0, 0, 0]), np.array([7.0, 0, 0]), 0.02415), BOTH, 0),
    ]
    write_plan(folder / "plan.json", planned)
    (path,) = export(folder, ["xlsx"], tmp_path / "out")
    book = load_workbook(path)
    assert book.sheetnames == ["Progress", "Pipes", "Planned", "Not seen", "TASK"]
    rows = list(book["Planned"].iter_rows(min_row=2, values_only=True))
    assert [row[:3] for row in rows] == [
        ("riser", "=DN65", "installed"),
        ("sprinkler 7", BOTH, "moved"),
        ("heating 3", BOTH, "not found"),
    ]
    assert rows[1][3:] == (pytest.approx(1.25), pytest.approx(1.25), pytest.approx(40.0), 0, "p03", "guid-2")
    (missing,) = book["Not seen"].iter_rows(min_row=2, values_only=True)
    assert missing == ("heating 3", BOTH, 2, 5, 0, 0, 7, 0, 0, "guid-3")
    # Their places tell the two systems of one size apart.
    progress = {row[0]: row[3] for row in book["Progress"].iter_rows(min_row=2, values_only=True)}
    assert progress["  sprinkler DN40"] == pytest.approx(1.25)
    assert progress["  heating DN40"] == 0
    tasks = dict(book["TASK"].iter_rows(min_row=3, values_only=True))
    assert tasks == {"A1010": pytest.approx(100 * 1.906 / 3.2), "A1020": 0, "A1030": pytest.approx(100 * 1.25 / 1.5)}


def test_a_plan_in_other_coordinates_is_told(folder: Path) -> None:
    site = np.array([691234.0, 5334567.0, 512.0])
    there = PIPES[0].cylinder.shifted(site)
    write_plan(folder / "plan.json", [PlannedPipe("guid-1", "riser", there, "=DN65", 0)])
    (told,) = plan_notes(folder)
    assert "the plan lies 5379 km away from the survey" in told
    assert told.endswith("is it in site coordinates? Give control points with --points")
    site_from_map = np.eye(4)
    site_from_map[:3, 3] = site
    assert plan_notes(folder, Alignment(Site(site_from_map), np.zeros(3), 1.0)) == []
    site_from_map[0, 3] += 300.0
    (told,) = plan_notes(folder, Alignment(Site(site_from_map), np.zeros(3), 1.0))
    assert "the plan lies 299 m away" in told
    assert told.endswith("are the control points in its coordinates?")


def test_a_plan_of_the_next_room_is_not_told_of(folder: Path) -> None:
    assert plan_notes(folder) == [], "without a plan"
    there = PIPES[0].cylinder.shifted(np.array([6.0, -6.0, 3.0]))
    write_plan(folder / "plan.json", [PlannedPipe("guid-1", "riser", there, "=DN65", 0)])
    assert plan_notes(folder) == []


def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    place = Cylinder(np.array([5.0, 0.125, 0]), np.array([7.0, 0, 0]), 0.02415)
    write_plan(tmp_path / "plan.json", [PlannedPipe("g", "n", place, "c", 2)])
    (read,) = read_plan(tmp_path / "plan.json")
    assert (read.id, read.name, read.class_name, read.line, read.cylinder.radius) == ("g", "n", "c", 2, 0.02415)
    np.testing.assert_array_equal([read.cylinder.start, read.cylinder.end], [place.start, place.end])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{}", "'pipes' is missing"),
        ('{"pipes": [{}]}', "planned pipe 1"),
        (f'{{"pipes": [{NO_LENGTH}]}}', "has no length"),
    ],
)
def test_a_damaged_plan_is_told(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(InputError, match=told):
        read_plan(tmp_path / "plan.json")
