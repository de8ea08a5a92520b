# SPDX-License-Identifier: Apache-2.0
"""A bill of quantities in YAML: a list `classes`."""

from __future__ import annotations

from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.file_kinds import kind_of
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.outside_text import nearest, shown
from pipeprog_detect.plan.entry import Entry, Plan


def read_yaml_bill(path: Path) -> Plan:
    """The bill in a BOQ.yaml; raises InputError where it is none."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no mapping: a bill of quantities begins with 'classes:'")
    if "classes" not in content and (kind := kind_of(content)):
        raise InputError(f"{path} is no bill of quantities: {kind}: are two files swapped?")
    for key in content:
        if key != "classes":
            raise InputError(
                f"{path}: unknown key {shown(key)} in the file: did you mean '{nearest(key, ('classes',))}'?"
            )
    entries = content.get("classes")
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path}{line_of(content, 'classes')}: classes is {shown(entries)}: "
            "list at least one class with name, radius and planned length"
        )
    return Plan([Entry(f"{path}{line_of(entries, number)}", entry) for number, entry in enumerate(entries)])
