# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in a table: its headings with their units, numbers with a decimal comma or a decimal point."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_DIGITS
from pipeprog_camera.outside_text import shown
from pipeprog_detect.plan.entry import Entry


@dataclass(frozen=True)
class FormulaWithoutValue:
    """What a cell holds whose formula was never calculated."""


Cell = str | int | float | bool | datetime | date | FormulaWithoutValue | None

# Headings in English and German, without unit, case, underscores and hyphens, by the key that they stand for.
_HEADINGS = {
    "name": ("name", "class", "pipe class", "designation", "klasse", "rohrklasse", "bezeichnung"),
    "outer_radius_mm": ("outer radius", "radius", "außenradius", "aussenradius"),
    "outer_diameter_mm": (
        *("outer diameter", "outside diameter", "diameter", "od"),
        *("außendurchmesser", "aussendurchmesser", "durchmesser"),
    ),
    "size": ("size", "standard size", "nominal size", "nennweite", "dimension"),
    "wall_mm": ("wall", "wall thickness", "wand", "wandstärke", "wanddicke"),
    "planned_length_m": ("planned length", "planned", "length", "quantity", "geplante länge", "länge", "menge"),
    "color": ("color", "colour", "farbe"),
    "material": ("material", "werkstoff"),
    "system": ("system", "anlage", "gewerk"),
    "zone": ("zone", "area", "bereich", "abschnitt"),
    "activity": ("activity", "activity id", "vorgang", "vorgangsnummer"),
    "start": ("start", "planned start", "beginn", "anfang"),
    "finish": ("finish", "planned finish", "end", "ende"),
}
_SIZES = ("outer_radius_mm", "outer_diameter_mm", "size")
_KEY_OF = {heading: key for key, headings in _HEADINGS.items() for heading in headings}
_METRES = {
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter"), 1e-3),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "zentimeter"), 1e-2),
    **dict.fromkeys(("m", "metre", "metres", "meter", "lfm"), 1.0),
    **dict.fromkeys(("in", "inch", "inches", "zoll", '"'), 0.0254),
    **dict.fromkeys(("ft", "feet", "foot"), 0.3048),
}
_UNIT = {"outer_radius_mm": 1e-3, "outer_diameter_mm": 1e-3, "wall_mm": 1e-3, "planned_length_m": 1.0}
_HEADING = re.compile(r"\s*(?P<name>[^\[\](){},]*?)\s*(?:[\[({,]\s*(?P<unit>[^\])}]*?)\s*[\])}]?\s*)?")
_ROWS_ABOVE = 20  # rows above the headings, at most: a letterhead, the project's name
_NUMBER = re.compile(r"[+-]?\d[\d.,\s'\u2019]*(?:e[+-]?\d+)?", re.IGNORECASE)
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})")


@dataclass(frozen=True)
class _Column:
    """A column that is used: its key, and what its numbers are multiplied with (0: it holds no numbers)."""

    index: int
    heading: str
    key: str
    factor: float


def table_entries(path: str, rows: Sequence[Sequence[Cell]]) -> list[Entry]:
    """The entries of a bill's rows, each row a sequence of cells; columns with other headings are left out.

    Raises InputError where there are no headings, a heading lacks its unit, or it cannot be told whether a comma or a
    point begins the decimals.
    """
    top = heading_row(rows)
    if top is None:
        raise InputError(
            f"{path} has no row of headings: write 'name', 'outer diameter [mm]' and 'planned length [m]' above the "
            "columns"
        )
    columns = _columns(f"{path}, row {top + 1}", rows[top])
    _require_size_and_length(f"{path}, row {top + 1}", rows[top], columns)
    body = [(number, row) for number, row in enumerate(rows[top + 1 :], top + 2) if any(_text(cell) for cell in row)]
    decimal = _decimal_mark(path, body, columns)
    return [
        Entry(f"{path}, row {number}", _values(f"{path}, row {number}", row, columns, decimal)) for number, row in body
    ]


def _require_size_and_length(where: str, row: Sequence[Cell], columns: Sequence[_Column]) -> None:
    """Raises InputError, naming the columns that are not understood, where none has the sizes, or none the lengths."""
    keys = {column.key for column in columns}
    used = {column.index for column in columns}
    others = [shown(_text(cell)) for index, cell in enumerate(row) if _text(cell) and index not in used]
    unknown = f": not understood: {', '.join(others)}" if others else ""
    if not keys & set(_SIZES):
        raise InputError(f"{where}: no column has the sizes{unknown}: write 'outer diameter [mm]' or 'size' above them")
    if "planned_length_m" not in keys:
        raise InputError(f"{where}: no column has the lengths{unknown}: write 'planned length [m]' above them")


def heading_row(rows: Sequence[Sequence[Cell]]) -> int | None:
    """Index of the row that holds the headings, at least that of names and another one; None where there is none."""
    for number, row in enumerate(rows[:_ROWS_ABOVE]):
        keys = {_key(_text(cell)) for cell in row} - {None}
        if "name" in keys and len(keys) > 1:
            return number
    return None


def is_bill(rows: Sequence[Sequence[Cell]]) -> bool:
    """Whether a table has the headings of names, sizes and lengths, and a row below them."""
    top = heading_row(rows)
    if top is None or not any(_text(cell) for row in rows[top + 1 :] for cell in row):
        return False
    keys = {_key(_text(cell)) for cell in rows[top]}
    return "planned_length_m" in keys and not keys.isdisjoint(_SIZES)


def _columns(where: str, row: Sequence[Cell]) -> list[_Column]:
    """The columns that are used of those that a row of headings names."""
    found = [(index, _text(cell)) for index, cell in enumerate(row) if _key(_text(cell))]
    keys = [_key(text) for _, text in found]
    double = next((key for key in keys if keys.count(key) > 1), None)
    if double is not None:
        names = " and ".join(shown(text) for _, text in found if _key(text) == double)
        raise InputError(f"{where}: the columns {names} say the same: keep one of them")
    return [_column(where, index, text) for index, text in found]


def _key(text: str) -> str | None:
    """The key that a heading stands for; a key of BOQ.yaml is one, too."""
    if text in _HEADINGS:
        return text
    found = _HEADING.fullmatch(text)
    name = re.sub(r"[\s_-]+", " ", found["name"].lower()) if found else ""
    return _KEY_OF.get(name)


def _column(where: str, index: int, text: str) -> _Column:
    key = _key(text)
    assert key is not None
    if key not in _UNIT or text == key:
        return _Column(index, text, key, 1.0 if key in _UNIT else 0.0)
    found = _HEADING.fullmatch(text)
    unit = (found["unit"] or "" if found else "").lower().rstrip(".")
    if unit not in _METRES:
        wanted = "mm" if key.endswith("_mm") else "m"
        better = f"{found['name'] if found else text} [{wanted}]"
        raise InputError(
            f"{where}: the column {shown(text)} names no unit of length: write {shown(better)} as its heading; "
            "units in cells or in a column of their own are not read"
        )
    return _Column(index, text, key, _METRES[unit] / _UNIT[key])


def _values(where: str, row: Sequence[Cell], columns: Sequence[_Column], decimal: str) -> dict[str, object]:
    """The values of a row by the keys of BOQ.yaml; empty cells are left out."""
    values: dict[str, object] = {}
    for column in columns:
        cell = row[column.index] if column.index < len(row) else None
        if not _text(cell):
            continue
        if isinstance(cell, FormulaWithoutValue):
            raise InputError(
                f"{where}, column {shown(column.heading)}: the cell holds a formula without a value: open the workbook "
                "in a spreadsheet program and save it"
            )
        if column.factor:
            number = _number(cell, decimal)
            # Nine decimals of a millimetre: what a factor such as 25.4 leaves of binary fractions is cut off.
            values[column.key] = cell if number is None else round(number * column.factor, 9)
        elif column.key in ("start", "finish"):
            values[column.key] = _day(where, column.heading, cell)
        elif isinstance(cell, float) and cell.is_integer():
            values[column.key] = int(cell)
        else:
            values[column.key] = cell
    if not values.keys() & set(_SIZES):
        name = f" of {shown(values['name'])}" if "name" in values else ""
        raise InputError(
            f"{where}: the row{name} has no size: delete it if it is a heading or a sum, or give it a size"
        )
    return values


def _text(cell: Cell) -> str:
    return "" if cell is None else str(cell).strip()


def _day(where: str, heading: str, cell: Cell) -> str:
    """`YYYY-MM-DD` of a date, or of a text with the day first and points; other texts as they are."""
    if isinstance(cell, datetime):
        return cell.date().isoformat()
    if isinstance(cell, date):
        return cell.isoformat()
    if found := _DAY_FIRST.fullmatch(_text(cell)):
        return f"{found[3]}-{int(found[2]):02d}-{int(found[1]):02d}"
    return _text(cell)


def _decimal_mark(path: str, body: Sequence[tuple[int, Sequence[Cell]]], columns: Sequence[_Column]) -> str:
    """`.` or `,`: what begins the decimals in the texts of the table's numbers.

    A mark that stands alone before exactly three digits may be that of thousands as well; when no other number of the
    table tells which it is, the user is asked.
    """
    seen: dict[str, tuple[str, str]] = {}  # mark -> where and which number shows it
    open_question: tuple[str, str] | None = None
    for number, row in body:
        for column in columns:
            text = row[column.index] if column.factor and column.index < len(row) else None
            if not isinstance(text, str) or not _NUMBER.fullmatch(text.strip()):
                continue
            place = f"{path}, row {number}, column {shown(column.heading)}", text.strip()
            mark = _shown_mark(text.strip())
            if mark == "?":
                open_question = open_question or place
            elif mark:
                seen.setdefault(mark, place)
    if len(seen) == 2:
        (one, first), (other, second) = seen["."], seen[","]
        raise InputError(
            f"{one}: {shown(first)} has a decimal point, and {other}: {shown(second)} a decimal comma: "
            "write all numbers alike"
        )
    if not seen and open_question is not None:
        where, text = open_question
        plain = re.sub(r"[.,]", "", text)
        raise InputError(
            f"{where}: is {shown(text)} {plain}, or {text.replace(',', '.')} with three decimals? "
            f"Write {plain}, or one decimal more"
        )
    return next(iter(seen), ".")


def _shown_mark(text: str) -> str:
    """The decimal mark that a number's text shows, `?` where it may be that of thousands, empty where it has none."""
    marks = [character for character in text if character in ".,"]
    if not marks:
        return ""
    if len(set(marks)) == 2:
        return marks[-1]
    if len(marks) > 1:
        return "," if marks[0] == "." else "."
    whole, decimals = re.split(r"[.,]", text)
    return "?" if re.fullmatch(r"\d{3}", decimals) and re.fullmatch(r"[+-]?[1-9]\d{0,2}", whole) else marks[0]


def _number(cell: Cell, decimal: str) -> float | None:
    """The number in a cell, None where it holds none."""
    if isinstance(cell, int | float):  # yes and no are whole numbers to Python
        return None if isinstance(cell, bool) or not abs(cell) < math.inf else float(cell)
    text = _text(cell)
    if len(text) > MAX_DIGITS or not _NUMBER.fullmatch(text):
        return None
    text = re.sub(r"[\s'\u2019]", "", text).replace("." if decimal == "," else ",", "")
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None
