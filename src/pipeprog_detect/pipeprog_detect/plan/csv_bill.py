# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in a CSV file, its columns parted by commas, semicolons or tabs."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_BILL_COLUMNS, MAX_BILL_ROWS, MAX_TEXT, MAX_YAML
from pipeprog_camera.text_file import read_text
from pipeprog_detect.plan.bill_table import table_entries
from pipeprog_detect.plan.entry import Entry

_SEPARATORS = (";", "\t", ",")  # a decimal comma stands beside semicolons or tabs: these are looked for first


def csv_entries(path: Path) -> list[Entry]:
    """The entries of a CSV file; raises InputError where it is none or has no headings."""
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
    return table_entries(str(path), rows)
