# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in a workbook of Excel or LibreOffice: the visible sheet that has its headings."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import require_regular
from pipeprog_camera.limits import MAX_BILL_COLUMNS, MAX_BILL_ROWS, MAX_SHEETS, MAX_XLSX, MAX_XLSX_CONTENT
from pipeprog_camera.outside_text import shown
from pipeprog_detect.plan.bill_table import Cell, FormulaWithoutValue, heading_row, is_bill, table_entries
from pipeprog_detect.plan.entry import Plan

_EXPORT_AGAIN = "save it as .xlsx again, or as CSV"
_SHEET = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"  # namespace of a sheet's elements


def read_xlsx_bill(path: Path) -> Plan:
    """The bill in a workbook; formulas count with the values that were saved with them, hidden rows with a note.

    Raises InputError where it is none, is larger than a bill can be, or not exactly one visible sheet has the headings.
    """
    require_regular(path)
    _check_sizes(path)
    with _damage_told(path):
        sheets = _visible_sheets(path)
    if not sheets:
        raise InputError(f"{path} has no visible sheet: {_EXPORT_AGAIN}")
    bills = [name for name, rows in sheets.items() if is_bill(rows)]
    if len(bills) > 1:
        raise InputError(
            f"{path}: the sheets {' and '.join(map(shown, bills))} are bills: put their rows into one sheet (a column "
            "'system' or 'zone' tells lines of one size apart), or hide the others"
        )
    with_headings = (name for name, rows in sheets.items() if heading_row(rows) is not None)
    name = bills[0] if bills else next(with_headings, next(iter(sheets)))
    where, rows = f"{path}, sheet {shown(name)}", sheets[name]
    with _damage_told(path):
        hidden, formulas = _hidden_and_formulas(path, name)
        for row, column in formulas:
            rows[row - 1][column - 1] = FormulaWithoutValue()
    entries = table_entries(where, rows)
    places = {entry.where for entry in entries}
    counted = [str(row) for row in hidden if f"{where}, row {row}" in places]
    remedy = "delete those that are not planned"
    notes = (f"{where}: hidden rows count, too: {', '.join(counted)}: {remedy}",) if counted else ()
    return Plan(entries, notes)


@contextmanager
def _damage_told(path: Path) -> Iterator[None]:
    """Raises InputError for what openpyxl and zipfile raise, which are exceptions of any type for damaged files."""
    try:
        yield
    except MemoryError:
        raise InputError(f"{path} does not fit into memory: {_EXPORT_AGAIN}") from None
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise InputError(f"{path} cannot be read as a workbook ({reason}): {_EXPORT_AGAIN}") from None


def _check_sizes(path: Path) -> None:
    """Compares what the archive declares with limits, before anything of it is inflated."""
    if path.stat().st_size > MAX_XLSX:
        raise InputError(f"{path} is larger than {MAX_XLSX >> 20} MiB, which no bill of quantities is: check the path")
    try:
        with zipfile.ZipFile(path) as archive:
            # zipfile inflates no part beyond the size that is declared for it.
            total = sum(part.file_size for part in archive.infolist())
            encrypted = any(part.flag_bits & 1 for part in archive.infolist())
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise InputError(f"{path} is no workbook ({error}): {_EXPORT_AGAIN}") from None
    if encrypted:
        raise InputError(f"{path} is encrypted: save it without a password")
    if total > MAX_XLSX_CONTENT:
        raise InputError(
            f"{path} inflates to {total >> 20} MiB, more than {MAX_XLSX_CONTENT >> 20}: keep the bill's sheet alone"
        )


def _visible_sheets(path: Path) -> dict[str, list[list[Cell]]]:
    """Rows of the sheets that are not hidden, by their names."""
    with _opened(path) as book:
        return {
            sheet.title: [
                list(row) for row in sheet.iter_rows(max_row=MAX_BILL_ROWS, max_col=MAX_BILL_COLUMNS, values_only=True)
            ]
            for sheet in book.worksheets[:MAX_SHEETS]
            if sheet.sheet_state == "visible"
        }


def _hidden_and_formulas(path: Path, name: str) -> tuple[list[int], list[tuple[int, int]]]:
    """Of a sheet: numbers of its hidden rows; row and column of each formula without a value, all from 1.

    openpyxl tells neither of a workbook that it does not read whole, and a hostile one would fill the memory then.
    """
    from openpyxl.utils.cell import coordinate_to_tuple

    hidden, formulas, number = [], [], 0
    with _opened(path) as book, zipfile.ZipFile(path) as archive, archive.open(book[name]._worksheet_path) as source:
        for _, row in ElementTree.iterparse(source):
            if row.tag != f"{_SHEET}row":
                continue
            number = int(row.get("r", number + 1))
            if number > MAX_BILL_ROWS:
                break
            if row.get("hidden") in ("1", "true"):
                hidden.append(number)
            for cell in row.iter(f"{_SHEET}c"):
                # The value of a formula that gives an empty text is empty, too, but its type is told.
                is_formula = cell.find(f"{_SHEET}f") is not None and cell.get("r") is not None
                if is_formula and not cell.findtext(f"{_SHEET}v") and cell.get("t") != "str":
                    formulas.append(coordinate_to_tuple(cell.get("r")))
            row.clear()
    return hidden, [(row, column) for row, column in formulas if column <= MAX_BILL_COLUMNS]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The workbook, read sheet by sheet; closed at the end."""
    from openpyxl import load_workbook  # a third of a second that only workbooks need

    book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
    try:
        yield book
    finally:
        book.close()
