# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in a CSV file, its columns parted by commas, semicolons or tabs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_text
from pipeprog_camera.limits import MAX_BILL_COLUMNS, MAX_BILL_ROWS, MAX_TEXT, MAX_YAML
from pipeprog_detect.plan.bill_table import heading_row, table_entries
from pipeprog_detect.plan.entry import Plan

_SEPARATORS = (";", "\t", ",")  # a decimal comma stands beside semicolons or tabs: these are looked for first


def read_csv_bill(path: Path) -> Plan:
    """The bill in a CSV file; raises InputError where it is none or has no headings."""
    text = read_text(path, MAX_YAML)
    first, _, rest = text.partition("\n")
    if first.strip().lower() in ("sep=;", "sep=,", "sep=\t"):  # a line that Excel writes and takes
        text = rest
    lines = text.splitlines()
    separator = next((mark for mark in _SEPARATORS if any(mark in line for line in lines)), ",")
    try:
        rows: list[list[str]] = []
        for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True):
            if len(rows) == MAX_BILL_ROWS or len(row) > MAX_BILL_COLUMNS:
                raise InputError(
                    f"{path}: more than {MAX_BILL_ROWS} rows or {MAX_BILL_COLUMNS} columns, which no bill has: "
                    "check the file"
                )
            rows.append([cell[:MAX_TEXT].replace("\u202f", " ").replace("\u00a0", " ") for cell in row])
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV ({error}): write the file again") from None
    _refuse_parted_numbers(path, rows)
    return Plan(table_entries(str(path), rows))


def _refuse_parted_numbers(path: Path, rows: Sequence[Sequence[str]]) -> None:
    """Raises InputError for a row with cells beyond the headings, such as `A,8,6,2,4` where 8,6 and 2,4 are meant."""
    top = heading_row(rows)
    if top is None:
        return
    headings = len(_filled(rows[top]))
    for number, row in enumerate(rows[top + 1 :], top + 2):
        if len(_filled(row)) > headings:
            raise InputError(
                f"{path}, row {number}: {len(_filled(row))} cells under {headings} headings: write decimals with a "
                "point, or part the columns by semicolons; give remarks a heading"
            )


def _filled(row: Sequence[str]) -> Sequence[str]:
    """A row without the empty cells at its end."""
    last = max((number for number, cell in enumerate(row) if cell.strip()), default=-1)
    return row[: last + 1]
