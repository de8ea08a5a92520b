# SPDX-License-Identifier: Apache-2.0
"""pipes.json read back, each field checked; docs/pipes.schema.json describes it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.limits import MAX_CLASSES, MAX_COORDINATE, MAX_PIPES
from pipeprog_camera.outside_text import name_of, shown

# Metres that were not found, by what the keyframes tell of their places.
COVERAGE_KEYS = ("missing_m", "unclear_m", "hidden_m", "not_seen_m")


@dataclass(frozen=True)
class PipesFile:
    """Content of a pipes.json: rows as the file has them; `walls_m2` is None where no coverage is told."""

    pipes: list[dict[str, Any]]
    classes: list[dict[str, Any]]
    runs: list[dict[str, Any]]
    scale: dict[str, Any]
    planned: list[dict[str, Any]]
    walls_m2: float | None


def read_pipes(path: Path) -> PipesFile:
    """The pipes.json of a run; raises InputError, naming the file and the row, where it is none."""
    content = read_json(path)
    try:
        file = PipesFile(
            pipes=rows_of(content, "pipes", MAX_PIPES),
            classes=rows_of(content, "classes", MAX_CLASSES),
            runs=rows_of({"runs": [], **content}, "runs", MAX_PIPES),
            scale=_scale(content.get("scale", {})),
            planned=rows_of({"planned": [], **content}, "planned", MAX_PIPES),
            walls_m2=number(content, "walls_m2", "the survey") if content.get("walls_m2") is not None else None,
        )
        for place, entry in enumerate(file.classes, 1):
            _check_class(entry, f"class {place}")
        for place, row in enumerate(file.planned, 1):
            _check_planned(row, f"planned pipe {place}")
        names = {entry["class"] for entry in file.classes}
        for place, pipe in enumerate(file.pipes, 1):
            _check_pipe(pipe, f"pipe {place}")
            if pipe["class"] is not None and pipe["class"] not in names:
                raise InputError(f"class {shown(pipe['class'])} of pipe {place} is not among its classes")
    except InputError as error:
        raise InputError(f"{path} is no pipes.json of pipeprog ({error}): run `pipeprog replay` again") from None
    return file


def rows_of(content: dict[str, Any], key: str, most: int) -> list[dict[str, Any]]:
    """A list of at most `most` objects; raises InputError where `content` has no such."""
    if key not in content:
        raise InputError(f"'{key}' is missing")
    rows = content[key]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{key} is {shown(rows)}, not a list of objects")
    if len(rows) > most:
        raise InputError(f"{len(rows)} {key}, more than {most}")
    return rows


def vector(entry: dict[str, Any], key: str, where: str) -> list[float]:
    """Three coordinates [m]; raises InputError where `entry` has no such."""
    value = entry.get(key)
    if key not in entry:
        raise InputError(f"'{key}' is missing in {where}")
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{key} of {where} is {shown(value)}, not three coordinates")
    return [number({key: one}, key, where, -MAX_COORDINATE) for one in value]


def number(entry: dict[str, Any], key: str, where: str, least: float = 0.0) -> float:
    """A number from `least` to MAX_COORDINATE; raises InputError where `entry` has no such."""
    value = entry.get(key)
    if key not in entry:
        raise InputError(f"'{key}' is missing in {where}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= MAX_COORDINATE:
        raise InputError(f"{key} of {where} is {shown(value)}, not a number from {least:g} to {MAX_COORDINATE:g}")
    return float(value)


def _scale(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not isinstance(value.get("source", ""), str):
        raise InputError(f"scale is {shown(value)}, not source and sigma")
    if value.get("sigma") is not None:
        number(value, "sigma", "the scale")
    return value


def _check_class(entry: dict[str, Any], where: str) -> None:
    for key in ("outer_radius", "planned_m", "installed_m"):
        number(entry, key, where)
    for key in ("installed_sigma_m", *COVERAGE_KEYS, "walls_seen_percent"):
        if entry.get(key) is not None:
            number(entry, key, where)
    if not isinstance(entry.get("class"), str):
        raise InputError(f"class of {where} is {shown(entry.get('class'))}, not a name")
    name_of(entry["class"], f"the name of {where}")


def _check_pipe(pipe: dict[str, Any], where: str) -> None:
    start, end = vector(pipe, "start", where), vector(pipe, "end", where)
    if start == end or number(pipe, "radius", where) == 0.0:
        raise InputError(f"{where} has no length or radius")
    number(pipe, "length", where)
    for key in ("radius_sigma", "rmse"):
        if pipe.get(key) is not None or key not in pipe:
            number(pipe, key, where)
    for key in (
        *("class_probability", "visible_arc_deg", "points", "length_sigma", "hidden_m", "not_seen_m"),
        "material_probability",
    ):
        if pipe.get(key) is not None:
            number(pipe, key, where)
    if not isinstance(pipe.get("id"), str):
        raise InputError(f"id of {where} is {shown(pipe.get('id'))}, not a name")
    name_of(pipe["id"], f"the id of {where}")
    if "life" in pipe:
        name_of(pipe["life"], f"the life of {where}")
    for row in rows_of({"ends": [], **pipe}, "ends", 2):
        _check_end(row, f"an end of {where}")
    if "class" not in pipe:
        raise InputError(f"'class' is missing in {where}")
    for key in ("class", "class_kmeans", "material"):
        if pipe.get(key) is not None and not isinstance(pipe[key], str):
            raise InputError(f"{key} of {where} is {shown(pipe[key])}, not a name")


def _check_planned(row: dict[str, Any], where: str) -> None:
    for key in ("id", "name", "class", "state"):
        if not isinstance(row.get(key), str):
            raise InputError(f"{key} of {where} is {shown(row.get(key))}, not a text")
    for key in ("planned_m", "installed_m", *COVERAGE_KEYS):
        number(row, key, where)
    if not isinstance(row.get("line", 0), int):
        raise InputError(f"line of {where} is {shown(row['line'])}, not the number of a line of its class")


def _check_end(row: dict[str, Any], where: str) -> None:
    if not isinstance(row.get("state"), str):
        raise InputError(f"state of {where} is {shown(row.get('state'))}, not a name")
    name_of(row["state"], f"the state of {where}")
    if row.get("sigma") is not None:
        number(row, "sigma", where)
