# SPDX-License-Identifier: Apache-2.0
"""The formats that a survey can be exported to, and the one way to write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeprog_bringup.export.csv_tables import write_classes, write_pipes
from pipeprog_bringup.export.ifc import write_ifc
from pipeprog_bringup.export.survey import Survey, read_survey
from pipeprog_bringup.export.xlsx import write_xlsx
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import nearest, shown

Writer = Callable[[Survey, Path], None]


@dataclass(frozen=True)
class Format:
    """A format: the files that it consists of, each with its writer."""

    files: dict[str, Writer]


FORMATS = {
    "xlsx": Format({"survey.xlsx": write_xlsx}),
    "ifc": Format({"survey.ifc": write_ifc}),
    "csv": Format({"classes.csv": write_classes, "pipes.csv": write_pipes}),
}


def export(folder: Path, names: Sequence[str], out: Path, force: bool = False) -> list[Path]:
    """Writes a results folder in the formats `names` into the folder `out`; returns the files.

    Raises InputError where the folder holds no results, a format is not known or needs what is not installed, or a
    file exists and `force` is not set.
    """
    for name in names:
        if name not in FORMATS:
            raise InputError(f"--to {shown(name)}: no such format: did you mean '{nearest(name, FORMATS)}'?")
    survey = read_survey(folder)
    written = []
    for name in dict.fromkeys(names):
        for file, write in FORMATS[name].files.items():
            with output_file(out / file, force) as temporary:
                write(survey, temporary)
            written.append(out / file)
    return written
