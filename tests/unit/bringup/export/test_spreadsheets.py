# SPDX-License-Identifier: Apache-2.0
"""XLSX and CSV as a second reader has them: right numbers in every locale, no formulas, the same bytes twice."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest
from openpyxl import load_workbook

from pipeprog_bringup.export.formats import export
from pipeprog_camera.errors import InputError


def test_a_workbook_holds_progress_pipes_and_activities(folder: Path, tmp_path: Path) -> None:
    (path,) = export(folder, ["xlsx"], tmp_path / "out")
    book = load_workbook(path)
    assert book.sheetnames == ["Progress", "Pipes", "TASK"]
    progress = list(book["Progress"].iter_rows(min_row=2, values_only=True))
    assert [row[0] for row in progress] == [
        *("=DN65", "heating DN40 + sprinkler DN40", "  heating DN40", "  sprinkler DN40"),
    ]
    assert progress[0][1:4] == pytest.approx((36.5, 3.2, 1.906))
    assert progress[0][5:10] == (pytest.approx(1.906 / 3.2), 1, "water", None, "A1010")
    assert progress[1][2:4] == pytest.approx((3.5, 1.25))
    assert progress[3][2:8] == (1.5, None, None, None, None, "sprinkler")
    assert [cell.data_type for cell in book["Progress"][2]][:4] == ["s", "n", "n", "n"]
    pipes = list(book["Pipes"].iter_rows(min_row=2, values_only=True))
    assert [row[:3] for row in pipes] == [
        ("p01", "=DN65", "r01"),
        ("p02", None, "r02"),
        ("p03", "heating DN40 + sprinkler DN40", "r03"),
    ]
    assert pipes[1][3] == pytest.approx(20.0)
    assert pipes[1][7:13] == pytest.approx((0.5, -0.2, 1.0, 1.7, 0.5, 1.0))
    # The metres of two systems of one size are told together, so nothing is said of their activities.
    assert list(book["TASK"].iter_rows(values_only=True)) == [
        ("task_code", "phys_complete_pct"),
        ("Activity ID", "Physical % Complete"),
        ("A1010", pytest.approx(100 * 1.906 / 3.2)),
    ]


def test_csv_has_whole_numbers_and_no_formulas(folder: Path, tmp_path: Path) -> None:
    classes, pipes = export(folder, ["csv"], tmp_path / "out")
    with classes.open(encoding="utf-8-sig", newline="") as stream:
        first, second = csv.DictReader(stream)
    assert first == {
        "class": "'=DN65",
        "outer_radius_um": "36500",
        "planned_mm": "3200",
        "installed_mm": "1906",
        "installed_sigma_um": "",
        "percent": "60",
        "pipes": "1",
        **dict.fromkeys(("missing_mm", "unclear_mm", "hidden_mm", "not_seen_mm", "walls_seen_percent"), ""),
    }
    assert second["installed_mm"] == "1250"
    with pipes.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [rows[1][key] for key in ("id", "length_mm", "start_x_mm", "start_y_mm", "end_x_mm")] == [
        *("p02", "1389", "500", "-200", "1700"),
    ]
    numbers = [cell for row in rows for key, cell in row.items() if key.rpartition("_")[2] in ("um", "mm", "percent")]
    assert all(re.fullmatch(r"-?\d*", cell) for cell in numbers)


def test_csv_and_workbook_tell_coverage_and_material(folder: Path, tmp_path: Path) -> None:
    content = json.loads((folder / "pipes.json").read_text())
    content["classes"][0] |= {"missing_m": 0.5, "not_seen_m": 0.7945, "walls_seen_percent": 83.2}
    content["pipes"][0] |= {"hidden_m": 0.25, "material": "copper", "material_probability": 0.987}
    content["pipes"][1] |= {"material": None, "material_probability": 0.6}
    (folder / "pipes.json").write_text(json.dumps(content))
    classes, pipes, book = export(folder, ["csv", "xlsx"], tmp_path / "out")
    with classes.open(encoding="utf-8-sig", newline="") as stream:
        first, second = csv.DictReader(stream)
    columns = ("missing_mm", "unclear_mm", "hidden_mm", "not_seen_mm", "walls_seen_percent")
    assert [first[key] for key in columns] == ["500", "", "", "794", "83"]
    assert {second[key] for key in columns} == {""}
    with pipes.open(encoding="utf-8-sig", newline="") as stream:
        rows = [
            [row[key] for key in ("hidden_mm", "not_seen_mm", "material", "material_probability_percent")]
            for row in csv.DictReader(stream)
        ]
    assert rows == [["250", "", "copper", "99"], ["", "", "", "60"], ["", "", "", ""]]
    sheet = list(load_workbook(book)["Pipes"].iter_rows(values_only=True))
    assert sheet[0][-2:] == ("Material seen", "Probability of the material")
    assert [row[-2:] for row in sheet[1:]] == [("copper", 0.987), (None, 0.6), (None, None)]


def test_the_same_results_give_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    once = export(folder, ["xlsx", "csv"], tmp_path / "once")
    again = export(folder, ["xlsx", "csv"], tmp_path / "again")
    assert [path.read_bytes() for path in once] == [path.read_bytes() for path in again]


def test_files_are_not_replaced_without_a_word(folder: Path, tmp_path: Path) -> None:
    export(folder, ["csv"], tmp_path / "out")
    with pytest.raises(InputError, match=r"classes\.csv exists: .*--force"):
        export(folder, ["csv"], tmp_path / "out")
    export(folder, ["CSV"], tmp_path / "out", force=True)


def test_an_unknown_format_is_told_with_the_nearest(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--to 'xslx': no such format: did you mean 'xlsx'"):
        export(folder, ["xslx"], tmp_path / "out")
    with pytest.raises(InputError, match="`pipeprog report DIR --pdf`"):
        export(folder, ["pdf"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
