# SPDX-License-Identifier: Apache-2.0
"""Bills of quantities in CSV and XLSX: the same as from YAML, whatever the locale; wrong ones are told."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import xlsxwriter
from openpyxl import Workbook

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_XLSX_CONTENT
from pipeprog_detect.product.boq import load_boq

YAML = """
classes:
  - {name: heating DN100, outer_diameter_mm: 114.3, planned_length_m: 1906.25, system: heating, zone: '2'}
  - {name: water DN100, outer_diameter_mm: 114.3, planned_length_m: 24.5, system: water, start: 2026-03-02}
  - {name: copper 22, outer_diameter_mm: 22, planned_length_m: 8.6, color: '#b87333', finish: 2026-04-30}
"""
HEADINGS_EN = [
    "Name",
    "Outer diameter [mm]",
    "Planned length [m]",
    "System",
    "Zone",
    "Start",
    "Finish",
    "Colour",
    "Price",
]
HEADINGS_DE = ["Bezeichnung", "Durchmesser (mm)", "Länge (m)", "Gewerk", "Bereich", "Beginn", "Ende", "Farbe", "Preis"]
ROWS_EN = [
    ["heating DN100", "114.3", "1,906.25", "heating", "2", "", "", "", "3"],
    ["water DN100", "114.3", "24.5", "water", "", "2026-03-02", "", "", ""],
    ["copper 22", "22", "8.6", "", "", "", "2026-04-30", "#b87333", ""],
]
ROWS_DE = [
    ["heating DN100", "114,3", "1.906,25", "heating", "2", "", "", "", "3"],
    ["water DN100", "114,3", "24,5", "water", "", "02.03.2026", "", "", ""],
    ["copper 22", "22", "8,60", "", "", "", "30.4.2026", "#b87333", ""],
]


def as_csv(rows: Sequence[Sequence[str]], separator: str) -> str:
    return "\n".join(separator.join(f'"{c}"' if separator in c else c for c in row) for row in rows) + "\n"


def workbook(path: Path, rows: Sequence[Sequence[Any]]) -> Path:
    book = Workbook()
    book.active.title = "Cover"
    sheet = book.create_sheet("Bill")
    for row in rows:
        sheet.append(list(row))
    book.save(path)
    return path


@pytest.fixture
def planned(tmp_path: Path) -> Any:
    path = tmp_path / "boq.yaml"
    path.write_text(YAML, encoding="utf-8")
    return load_boq(path)


@pytest.mark.parametrize(
    ("headings", "rows", "separator"),
    [
        (HEADINGS_EN, ROWS_EN, ","),
        (HEADINGS_EN, ROWS_EN, ";"),
        (HEADINGS_DE, ROWS_DE, ";"),
        (HEADINGS_DE, ROWS_DE, "\t"),
    ],
)
def test_a_csv_gives_the_same_bill_as_yaml(
    tmp_path: Path, planned: Any, headings: list[str], rows: list[list[str]], separator: str
) -> None:
    path = tmp_path / "boq.csv"
    lines = [["Project 7"], [], headings, *rows, []]
    path.write_text(as_csv(lines, separator), encoding="utf-8-sig")
    assert load_boq(path) == planned
    path.write_text(f"sep={separator}\n" + as_csv([headings, *rows], separator), encoding="utf-8")
    assert load_boq(path) == planned


@pytest.mark.parametrize(("headings", "rows"), [(HEADINGS_EN, ROWS_EN), (HEADINGS_DE, ROWS_DE)])
def test_a_workbook_gives_the_same_bill_as_yaml(
    tmp_path: Path, planned: Any, headings: list[str], rows: list[list[str]]
) -> None:
    assert load_boq(workbook(tmp_path / "texts.xlsx", [headings, *rows])) == planned
    numbers: list[list[Any]] = [
        ["heating DN100", 114.3, 1906.25, "heating", 2],
        ["water DN100", 114.3, 24.5, "water", None, date(2026, 3, 2)],
        [],
        ["copper 22", 22.0, 8.6, None, None, None, date(2026, 4, 30), "#b87333"],
    ]
    assert load_boq(workbook(tmp_path / "numbers.xlsx", [["Bill of quantities"], headings, *numbers])) == planned


def test_units_stand_in_the_headings(tmp_path: Path) -> None:
    path = tmp_path / "boq.csv"
    path.write_text("class,outer diameter [in],wall [cm],length (ft)\nNPS 4,4.5,0.6,100\n")
    (one,) = load_boq(path).classes
    assert (one.outer_radius, one.wall, one.planned_length) == pytest.approx((0.05715, 0.006, 30.48))


def test_lines_of_one_size_are_one_class_that_knows_them(planned: Any) -> None:
    both, copper = planned.classes
    assert both.name == "heating DN100 + water DN100"
    assert both.planned_length == 1930.75
    assert [(line.name, line.system, line.zone, line.start) for line in both.lines] == [
        ("heating DN100", "heating", "2", ""),
        ("water DN100", "water", "", "2026-03-02"),
    ]
    assert copper.lines[0].finish == "2026-04-30"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "has no row of headings: write 'name', 'outer diameter [mm]'"),
        ("a,b\n1,2\n", "has no row of headings"),
        (
            "name,diameter,length [m]\nA,60.3,3\n",
            "row 1: the column 'diameter' names no unit of length: write 'diameter [mm]'",
        ),
        ("name,diameter [kg],length [m]\nA,60.3,3\n", "names no unit of length"),
        ("name,size,quantity,unit\nA,DN50 steel,3,m\n", "'quantity [m]' as its heading; units in cells or in a column"),
        ("name,DN,length [m]\nA,50,3\n", "row 1: no column has the sizes: not understood: 'DN': write 'outer diam"),
        (
            "name,size,price,Länge\u00b2\nA,DN50 steel,3,4\n",
            "no column has the lengths: not understood: 'price', 'Läng",
        ),
        ("name,size,length [m]\n1. Heating,,\nA,DN50 steel,3\n", "row 2: the row of '1. Heating' has no size: delete"),
        (
            "name,size,length [m]\nA,DN50 steel,3\n,,3\n",
            "row 3: the row has no size: delete it if it is a heading or a",
        ),
        ("name,diameter [mm],od [in],length [m]\nA,60.3,,3\n", "'diameter [mm]' and 'od [in]' say the same"),
        ("name,diameter [mm],length [m]\n", "names no class"),
        ("name,diameter [mm],length [m]\nA,60.3,\n", "row 2: class 'A' has no planned_length_m"),
        ("name,diameter [mm],length [m]\n,60.3,5\n", "row 2: class 1 has no name"),
        (
            "name,diameter [mm],length [m]\nA,60.3,five\n",
            "row 2: class 'A': planned_length_m is 'five': write a number",
        ),
        ("name;diameter [mm];length [m]\nA;60;1.906\n", "is '1.906' 1906, or 1.906 with three decimals?"),
        ("name;diameter [mm];length [m]\nA;60,3;8.5\n", "8.5' has a decimal point, and"),
        ("name,diameter [mm],length [m]\nA,17,2,2,4\n", "row 2: 5 cells under 3 headings: write decimals with a point"),
        ('name;diameter [mm];length [m]\n"A;60\n', "is no CSV"),
        ("name,size,length [m],start\nA,DN50 steel,3,03/01/2026\n", "write the date as YYYY-MM-DD"),
        ("name,size,length [m],start,finish\nA,DN50 steel,3,2026-05-01,2026-04-01\n", "lies before start 2026-05-01"),
        ("name,size,length [m]\n" + "A,DN50 steel,3\n" * 5001, "more than 5000 rows"),
    ],
    ids=lambda text: repr(text)[:40],
)
def test_a_wrong_table_is_reported_with_its_remedy(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "boq.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_boq(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [(["1.906", "8.60"], [1.906, 8.6]), (["1,906", "8,60"], [1.906, 8.6]), (["1.906,5", "8"], [1906.5, 8.0])],
)
def test_other_numbers_tell_what_a_mark_before_three_digits_is(
    tmp_path: Path, lengths: list[str], expected: list[float]
) -> None:
    path = tmp_path / "boq.csv"
    one, two = lengths
    path.write_text(f"name;size;length [m]\nA;DN50 steel;{one}\nB;DN65 steel;{two}\n")
    assert [planned.planned_length for planned in load_boq(path).classes] == expected


def test_a_workbook_that_inflates_beyond_measure_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    path = workbook(tmp_path / "bomb.xlsx", [HEADINGS_EN, *ROWS_EN])
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/media/image1.bin", bytes(MAX_XLSX_CONTENT))
    with pytest.raises(InputError, match="inflates to 64 MiB"):
        load_boq(path)


BILL: list[list[Any]] = [["Name", "Outer diameter [mm]", "Length [m]"], ["A", 60.3, 3], ["B", 76.1, 2]]


def sheets(path: Path, content: Mapping[str, Sequence[Sequence[Any]]], hidden: Sequence[str] = ()) -> Path:
    book = Workbook()
    book.remove(book.active)
    for name, rows in content.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
        sheet.sheet_state = "hidden" if name in hidden else "visible"
    book.save(path)
    return path


def test_hidden_sheets_are_not_read(tmp_path: Path) -> None:
    old = [BILL[0], ["OLD", 48.3, 99]]
    path = sheets(tmp_path / "boq.xlsx", {"2024": old, "Bill": BILL}, hidden=["2024"])
    assert [planned.name for planned in load_boq(path).classes] == ["A", "B"]


def test_two_bills_in_a_workbook_are_told(tmp_path: Path) -> None:
    path = sheets(tmp_path / "boq.xlsx", {"Heating": BILL, "Water": [BILL[0], ["C", 33.7, 5]]})
    with pytest.raises(InputError, match=r"the sheets 'Heating' and 'Water' are bills: put their rows into one sheet"):
        load_boq(path)
    others = {"Contacts": [["Name", "Area"], ["Kim", "north"]], "Template": [BILL[0]], "Bill": BILL}
    assert [planned.name for planned in load_boq(sheets(path, others)).classes] == ["A", "B"]


def test_hidden_rows_count_and_are_told(tmp_path: Path) -> None:
    book = Workbook()
    for row in [*BILL, ["C", 33.7, 5], []]:
        book.active.append(row)
    for number in (1, 3, 5):
        book.active.row_dimensions[number].hidden = True
    book.save(tmp_path / "boq.xlsx")
    bill = load_boq(tmp_path / "boq.xlsx")
    assert len(bill.classes) == 3
    (note,) = bill.notes
    assert note.endswith("sheet 'Sheet': hidden rows count, too: 3: delete those that are not planned")


def test_a_formula_without_a_value_is_told(tmp_path: Path) -> None:
    path = sheets(tmp_path / "boq.xlsx", {"Bill": [*BILL, ["C", 33.7, "=1.6*2"]]})
    with pytest.raises(
        InputError, match=r"row 4, column 'Length \[m\]': the cell holds a formula without a value: open"
    ):
        load_boq(path)
    with xlsxwriter.Workbook(tmp_path / "values.xlsx") as book:
        sheet = book.add_worksheet()
        for number, row in enumerate(BILL):
            sheet.write_row(number, 0, row)
        sheet.write_formula(2, 2, "=1.6*2", None, 3.2)
        for column in range(3):
            sheet.write_formula(3, column, '=IF(D4="","",1)', None, "")
    # Excel and LibreOffice tell the type of a formula that gives an empty text; XlsxWriter does not.
    with zipfile.ZipFile(tmp_path / "values.xlsx") as written, zipfile.ZipFile(path, "w") as archive:
        for part in written.namelist():
            archive.writestr(part, written.read(part).replace(b'"><f>IF(', b'" t="str"><f>IF('))
    assert [planned.planned_length for planned in load_boq(path).classes] == [3.0, 3.2]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"name,size\n", b"\xd0\xcf\x11\xe0" * 200])
def test_what_is_no_workbook_is_told_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "boq.xlsx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"boq\.xlsx .*save it as \.xlsx again"):
        load_boq(path)


def test_an_archive_without_sheets_and_a_format_of_old_are_told(tmp_path: Path) -> None:
    path = tmp_path / "boq.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "b")
    with pytest.raises(InputError, match="cannot be read as a workbook"):
        load_boq(path)
    with pytest.raises(InputError, match=r"\.ods is no format of bills"):
        load_boq(tmp_path / "boq.ods")
