# SPDX-License-Identifier: Apache-2.0
"""The plan in a file of any kind: what its name ends with tells the reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_detect.plan.csv_bill import read_csv_bill
from pipeprog_detect.plan.entry import Plan
from pipeprog_detect.plan.ifc_plan import read_ifc_plan
from pipeprog_detect.plan.xlsx_bill import read_xlsx_bill
from pipeprog_detect.plan.yaml_bill import read_yaml_bill

_READERS: dict[str, Callable[[Path], Plan]] = {
    ".yaml": read_yaml_bill,
    ".yml": read_yaml_bill,
    ".csv": read_csv_bill,
    ".xlsx": read_xlsx_bill,
    ".ifc": read_ifc_plan,
}


def read_plan(path: Path) -> Plan:
    """A plan, its entries not checked; a file whose name tells no kind is read as YAML.

    Raises InputError, naming the file and the remedy, where it cannot be read as what it is called.
    """
    if path.suffix.lower() in (".xls", ".ods", ".xlsm", ".xlsb"):
        raise InputError(f"{path}: {path.suffix} is no format of bills: save the sheet as .xlsx or .csv")
    plan = _READERS.get(path.suffix.lower(), read_yaml_bill)(path)
    if not plan.entries:
        raise InputError(f"{path} names no class: write at least one below the headings")
    return plan
