# SPDX-License-Identifier: Apache-2.0
"""plan.json: the planned pipes with their places, kept beside the results of a run whose plan has them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeprog_bringup.results.pipes_file import number, rows_of, vector
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.limits import MAX_PIPES
from pipeprog_camera.outside_text import shown
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.types import Cylinder


def write_plan(path: Path, pipes: Sequence[PlannedPipe]) -> None:
    """plan.json, one line a planned pipe; lengths in the plan's coordinates, rounded to the micrometre."""
    rows = [
        {
            "id": pipe.id,
            "name": pipe.name,
            "class": pipe.class_name,
            "line": pipe.line,
            "start": [round(float(value), 6) for value in pipe.cylinder.start],
            "end": [round(float(value), 6) for value in pipe.cylinder.end],
            "radius": round(pipe.cylinder.radius, 6),
        }
        for pipe in pipes
    ]
    lines = ",\n  ".join(json.dumps(row, allow_nan=False) for row in rows)
    path.write_text(f'{{"pipes": [\n  {lines}]}}\n')


def read_plan(path: Path) -> list[PlannedPipe]:
    """The planned pipes of a plan.json; raises InputError, naming the file and the row, where it is none."""
    content = read_json(path)
    try:
        return [
            _planned(row, f"planned pipe {place}") for place, row in enumerate(rows_of(content, "pipes", MAX_PIPES), 1)
        ]
    except InputError as error:
        raise InputError(f"{path} is no plan.json of pipeprog ({error}): run `pipeprog replay` again") from None


def _planned(row: dict[str, object], where: str) -> PlannedPipe:
    texts = [row.get(key) for key in ("id", "name", "class")]
    line = row.get("line")
    if not all(isinstance(text, str) for text in texts) or not isinstance(line, int):
        raise InputError(
            f"id, name, class and line of {where} are {shown([*texts, line])}, not three texts and a number"
        )
    start, end = (np.array(vector(row, key, where)) for key in ("start", "end"))
    radius = number(row, "radius", where)
    if (start == end).all() or radius == 0.0:
        raise InputError(f"{where} has no length or radius")
    identity, name, class_name = map(str, texts)
    return PlannedPipe(identity, name, Cylinder(start, end, radius), class_name, line)
