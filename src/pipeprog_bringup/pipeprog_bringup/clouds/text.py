# SPDX-License-Identifier: Apache-2.0
"""Points in text, one a line."""

from __future__ import annotations

from pathlib import Path

from pipeprog_bringup.clouds.columns import COLORS, Columns, Field, read_rows, wanted
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_LINE


def read_text(path: Path) -> Columns:
    """Columns of numbers (blanks, commas or semicolons between them), x y z first unless a line of names differs."""
    names, skipped, separator = ["x", "y", "z"], 0, None
    with path.open("rb") as stream:
        for _ in range(100):
            start = stream.tell()
            line = stream.readline(MAX_CLOUD_LINE).decode("utf-8", "replace").strip()
            text = line.lstrip("#/").strip()
            separator = next((mark for mark in (";", ",") if mark in text), None)
            cells = [cell.strip() for cell in text.split(separator)] if text else []
            if len(cells) >= 3 and _numeric(cells[:3]) and not line.startswith(("#", "/")):
                break
            # A line of fewer numbers is the count that opens a .pts file.
            if {"x", "y", "z"} <= {cell.lower().strip('"') for cell in cells}:
                names = [cell.lower().strip('"') for cell in cells]
            skipped += 1
        else:
            raise InputError(f"{path}: no line of three numbers among the first {skipped}: it is no list of points")
        stream.seek(start)
        positions = wanted(path, names[: len(cells)])
        fields = {name: Field("f8", i, 0) for name, i in positions.items() if name not in COLORS}
        return read_rows(path, stream, fields, delimiter=separator, comments=["#", "//"])


def _numeric(cells: list[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False
