# SPDX-License-Identifier: Apache-2.0
"""The plan in a file of any kind: what its name ends with tells the reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_detect.plan.csv_bill import csv_entries
from pipeprog_detect.plan.entry import Entry
from pipeprog_detect.plan.ifc_plan import ifc_entries
from pipeprog_detect.plan.xlsx_bill import xlsx_entries
from pipeprog_detect.plan.yaml_bill import yaml_entries

_READERS: dict[str, Callable[[Path], list[Entry]]] = {
    ".yaml": yaml_entries,
    ".yml": yaml_entries,
    ".csv": csv_entries,
    ".xlsx": xlsx_entries,
    ".ifc": ifc_entries,
}


def read_plan(path: Path) -> list[Entry]:
    """The entries of a plan, not checked; a file whose name tells no kind is read as YAML.

    Raises InputError, naming the file and the remedy, where it cannot be read as what it is called.
    """
    if path.suffix.lower() in (".xls", ".ods", ".xlsm", ".xlsb"):
        raise InputError(f"{path}: {path.suffix} is no format of bills: save the sheet as .xlsx or .csv")
    entries = _READERS.get(path.suffix.lower(), yaml_entries)(path)
    if not entries:
        raise InputError(f"{path} names no class: write at least one below the headings")
    return entries
