# SPDX-License-Identifier: Apache-2.0
"""Markdown of tables and lists, for the documents that are written from results/."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def rows_table(rows: Sequence[dict[str, Any]], without: Sequence[str] = ()) -> str:
    """A table of a result's rows, a column for each key but those `without`."""
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if key not in without]
    return table(map(heading, keys), [[cell(row.get(key)) for key in keys] for row in rows])


def measured_rows(figures: Mapping[str, Any], of: str = "") -> list[dict[str, Any]]:
    """Rows of what was measured and its value, of figures that lie within each other."""
    rows = []
    for name, value in figures.items():
        what = f"{of}: {name}" if of else name
        if isinstance(value, Mapping):
            rows += measured_rows(value, what)
        else:
            rows.append({"what": heading(what), "measured": "none" if value == [] else value})
    return rows


def table(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with that head; all cells are text."""
    first = list(head)
    lines = [first, ["---"] * len(first), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bullets(items: Iterable[str]) -> str:
    """A list with one line for each item."""
    return "".join(f"- {item}\n" for item in items) or "- nothing\n"


def heading(key: str) -> str:
    """The head of a column: `radius_rmse_mm` becomes `radius RMSE [mm]`."""
    words = key.replace("_", " ").replace("rmse", "RMSE")
    return re.sub(r" (mm|ms|m|deg)(?= |$)", r" [\1]", words)


def cell(value: Any) -> str:
    """A value as it stands in a table: `-` for what is missing, names and values of a mapping side by side."""
    if value is None or value == []:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{name}: {cell(part)}" for name, part in value.items())
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1e5 else f"{value:g}"
    return str(value)
