# SPDX-License-Identifier: Apache-2.0
"""The two files that are scored: the pipes of a result and the ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.results.pipes_file import number, rows_of, vector
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.file_kinds import kind_of
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.limits import MAX_CLASSES, MAX_COORDINATE, MAX_SCORED
from pipeprog_camera.outside_text import name_of, shown


@dataclass(frozen=True)
class Segment:
    """A cylinder of the truth or of the result: ends (3,) [m], radius [m], length [m], id, class or None.

    `radius_sigma`, `length_sigma`: standard deviations [m], None where they are not known.
    """

    start: FloatArray
    end: FloatArray
    radius: float
    length: float
    id: str
    class_name: str | None = None
    radius_sigma: float | None = None
    length_sigma: float | None = None


@dataclass(frozen=True)
class Result:
    """The content of pipes.json: detections in `map`, and the classes' radii [m]."""

    pipes: tuple[Segment, ...]
    class_radii: dict[str, float]


@dataclass(frozen=True)
class Truth:
    """Ground truth in its own frame `world`: pipes, cylinders to ignore, poses (N, 4, 4) of each frame's camera.

    `stamps`: of the frames, (N,) int64 ns; None where the truth has none.
    """

    pipes: tuple[Segment, ...]
    ignore: tuple[Segment, ...]
    world_from_camera: FloatArray
    stamps: NDArray[np.int64] | None = None


def read_result(path: Path) -> Result:
    """The pipes.json of a run; raises InputError where it is none."""
    content = read_json(path)
    if isinstance(content, dict) and "classes" not in content and (kind := kind_of(content)):
        raise InputError(f"{path} is no pipes.json of pipeprog: {kind}: give the results first, then the truth")
    try:
        pipes = tuple(_segment(pipe, str(pipe.get("id")), f"pipe {n}") for n, pipe in _numbered(content, "pipes"))
        rows = rows_of(content, "classes", MAX_CLASSES)
        class_radii = {
            str(row.get("class")): number(row, "outer_radius", f"class {n}") for n, row in enumerate(rows, 1)
        }
        for pipe in pipes:
            if pipe.class_name is not None and pipe.class_name not in class_radii:
                raise InputError(f"class {shown(pipe.class_name)} of a pipe is not among its classes")
    except InputError as error:
        raise InputError(f"{path} is no pipes.json of pipeprog ({error}): run `pipeprog replay` again") from None
    return Result(pipes, class_radii)


def read_truth(path: Path) -> Truth:
    """A truth file; raises InputError where it is none."""
    content = read_json(path)
    if isinstance(content, dict) and "scale" in content and (kind := kind_of(content)):
        raise InputError(f"{path} is no truth file: {kind}: give the results first, then the truth")
    try:
        pipes = tuple(
            _segment(pipe, str(pipe.get("id", n - 1)), f"pipe {n}") for n, pipe in _numbered(content, "pipes")
        )
        ignored = _numbered({"ignore": [], **content}, "ignore")
        ignore = tuple(_segment(pipe, "ignore", f"cylinder {n} to ignore") for n, pipe in ignored)
        poses = _poses(content.get("camera_to_world", []))
        stamps = _stamps(content["stamps"], len(poses)) if "stamps" in content else None
    except InputError as error:
        raise InputError(f"{path} is no truth file ({error}): it needs pipes with start, end, radius") from None
    return Truth(pipes, ignore, poses, stamps)


def _numbered(content: dict[str, Any], key: str) -> Iterable[tuple[int, dict[str, Any]]]:
    return enumerate(rows_of(content, key, MAX_SCORED), 1)


def _poses(value: Any) -> FloatArray:
    """(N, 4, 4) of nested lists."""
    try:
        poses = np.asarray(value, float).reshape(-1, 4, 4)
    except (TypeError, ValueError):
        raise InputError(f"camera_to_world is {shown(value)}, not a list of 4 x 4 matrices") from None
    if not (np.abs(poses) <= MAX_COORDINATE).all():
        raise InputError(f"camera_to_world holds more than {MAX_COORDINATE:g} m")
    return poses


def _stamps(value: Any, count: int) -> NDArray[np.int64]:
    """(N,) stamps [ns] of `count` poses."""
    if not isinstance(value, list) or len(value) != count or not all(type(one) is int and one >= 0 for one in value):
        raise InputError(f"stamps is {shown(value)}, not a list of {count} times in ns, one for each pose")
    if max(value, default=0) > np.iinfo(np.int64).max:
        raise InputError(f"stamps holds {max(value)}: a time in ns has 63 bits at most")
    return np.array(value, np.int64)


def _segment(entry: dict[str, Any], name: Any, where: str) -> Segment:
    start, end = (np.array(vector(entry, key, where)) for key in ("start", "end"))
    radius, distance = number(entry, "radius", where), float(np.linalg.norm(end - start))
    if radius == 0.0 or distance == 0.0:
        raise InputError(f"{where} has no length or radius")
    class_name = entry.get("class")
    if not isinstance(class_name, str | None):
        raise InputError(f"class of {where} is {shown(class_name)}, not a name")
    length = number({"length": distance, **entry}, "length", where)
    sigmas = (None if entry.get(key) is None else number(entry, key, where) for key in ("radius_sigma", "length_sigma"))
    return Segment(start, end, radius, length, name_of(name, f"id of {where}"), class_name, *sigmas)
