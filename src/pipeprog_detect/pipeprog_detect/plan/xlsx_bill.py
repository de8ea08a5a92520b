# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in a workbook of Excel or LibreOffice: the first sheet that has its headings."""

from __future__ import annotations

import zipfile
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_BILL_COLUMNS, MAX_BILL_ROWS, MAX_SHEETS, MAX_XLSX, MAX_XLSX_CONTENT
from pipeprog_camera.outside_text import shown
from pipeprog_camera.text_file import require_regular
from pipeprog_detect.plan.bill_table import Cell, heading_row, table_entries
from pipeprog_detect.plan.entry import Entry

_EXPORT_AGAIN = "save it as .xlsx again, or as CSV"


def xlsx_entries(path: Path) -> list[Entry]:
    """The entries of a workbook; formulas count with the values that were saved with them.

    Raises InputError where it is none, is larger than a bill can be, or no sheet has the headings.
    """
    require_regular(path)
    _check_sizes(path)
    try:
        sheets = _sheets(path)
    except MemoryError:
        raise InputError(f"{path} does not fit into memory: {_EXPORT_AGAIN}") from None
    # openpyxl raises exceptions of any type for damaged files.
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise InputError(f"{path} cannot be read as a workbook ({reason}): {_EXPORT_AGAIN}") from None
    if not sheets:
        raise InputError(f"{path} has no sheet: {_EXPORT_AGAIN}")
    name = next((name for name, rows in sheets.items() if heading_row(rows) is not None), next(iter(sheets)))
    return table_entries(f"{path}, sheet {shown(name)}", sheets[name])


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


def _sheets(path: Path) -> dict[str, list[list[Cell]]]:
    from openpyxl import load_workbook  # a third of a second that only workbooks need

    book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
    try:
        return {
            sheet.title: [
                list(row) for row in sheet.iter_rows(max_row=MAX_BILL_ROWS, max_col=MAX_BILL_COLUMNS, values_only=True)
            ]
            for sheet in book.worksheets[:MAX_SHEETS]
        }
    finally:
        book.close()
