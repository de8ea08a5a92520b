# SPDX-License-Identifier: Apache-2.0
"""A results folder read back: tables as lists of rows, geometry as arrays; docs/files.md names every field."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.results.cloud_io import CloudFile, read_cloud
from pipeprog_bringup.results.pipes_file import read_pipes
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.files.text_file import read_text
from pipeprog_camera.files.yaml_file import read_yaml
from pipeprog_camera.limits import MAX_TABLE
from pipeprog_detect.types import Cylinder
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map

Color = tuple[float, float, float]

UNPLANNED: Color = (0.55, 0.55, 0.58)  # grey: a pipe of no planned class
_TEXT_COLUMNS = {"reason"}
_WHOLE_COLUMNS = {"stamp", "tie_points"}
_YES_NO_COLUMNS = {"chosen", "registered"}
# Entries of run.json that are shown or followed, and their types.
_FACT_TYPES: dict[str, type] = {
    **dict.fromkeys(("command", "bag", "cloud", "finished"), str),
    **dict.fromkeys(("frames_considered", "frames_in_bag", "keyframes", "registered", "points"), int),
    **dict.fromkeys(("notes", "losses", "files"), list),
    **dict.fromkeys(("timings_s", "versions", "seeds"), dict),
}


@dataclass(frozen=True)
class Results:
    """The results of one run; what its folder does not hold is empty or None.

    Attributes:
        folder: where they were read from.
        pipes: rows of pipes.json, one a pipe, with its fields: `id`, `start`, `end`, `radius` [m], `class`, ...
        classes: rows of pipes.json, one a planned class: `class`, `planned_m`, `installed_m`, `percent`, ...
        runs: rows of pipes.json, one for each set of pipes that fittings connect.
        planned: rows of pipes.json, one a planned pipe; empty where the plan has no places.
        walls_m2: area of the walls that were found; None where no coverage is told.
        scale: where the metres come from, `source` and relative `sigma`.
        facts: run.json, how the run went.
        config: config.yaml, the settings in force and the bill of quantities.
        stamps: (M,) int64 [ns] of the keyframes.
        map_from_camera: (M, 4, 4) poses of the keyframes' optical frames [m].
    """

    folder: Path
    pipes: list[dict[str, Any]]
    classes: list[dict[str, Any]]
    runs: list[dict[str, Any]]
    planned: list[dict[str, Any]]
    walls_m2: float | None
    scale: dict[str, Any]
    facts: dict[str, Any]
    config: dict[str, Any]
    stamps: NDArray[np.int64]
    map_from_camera: FloatArray

    @property
    def cylinders(self) -> list[Cylinder]:
        """Geometry of the pipes, in their order."""
        return [
            Cylinder(np.array(pipe["start"], float), np.array(pipe["end"], float), float(pipe["radius"]))
            for pipe in self.pipes
        ]

    @cached_property
    def colors(self) -> dict[str, Color]:
        """RGB in 0..1 of each class as config.yaml has it; without that, colours that can be told apart."""
        given = self.config.get("boq", [])
        try:
            return {str(entry["name"]): _rgb(entry["color"]) for entry in given} or _palette(self.classes)
        except (AttributeError, KeyError, TypeError, ValueError):
            return _palette(self.classes)

    @cached_property
    def frames(self) -> list[dict[str, Any]]:
        """Rows of frames.csv, one a frame considered; raises InputError where the file is damaged."""
        path = self.folder / "frames.csv"
        if not path.is_file():
            return []
        try:
            rows = csv.DictReader(io.StringIO(read_text(path, MAX_TABLE), newline=""))
            return [{name: _cell(name, text) for name, text in row.items()} for row in rows]
        except (AttributeError, TypeError, ValueError, csv.Error) as error:
            raise InputError(f"{path} is no frames.csv ({error}): run `pipeprog replay` again") from None

    @property
    def cloud_path(self) -> Path | None:
        """The cloud that the pipes were found in: cloud.ply of a replay, the file given to `pipeprog detect`."""
        own = self.folder / "cloud.ply"
        path = own if own.is_file() else Path(str(self.facts.get("cloud", "")))
        return path if path.is_file() else None

    @cached_property
    def cloud(self) -> CloudFile | None:
        """The cloud with its normals and colours, read when it is first asked for."""
        return None if self.cloud_path is None else read_cloud(self.cloud_path)

    @cached_property
    def frame(self) -> str | None:
        """Name of the frame `map`, the same for surveys that were aligned with each other; None without map.npz."""
        path = self.folder / MAP_FILE
        return read_map(path).frame if path.is_file() else None

    @property
    def points(self) -> FloatArray:
        """(N, 3) points of the cloud [m] in `map`."""
        return np.empty((0, 3)) if self.cloud is None else self.cloud.cloud.points


def read_results(folder: str | Path) -> Results:
    """Reads the folder that `pipeprog replay` or `pipeprog detect` has written; only pipes.json must be there.

    Raises InputError, naming the file and the remedy, where it is no such folder or a file in it is damaged.
    """
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder} is a file: give the folder that `pipeprog replay` or `pipeprog detect` has written")
    if not folder.is_dir():
        raise InputError(f"no such folder: {folder}")
    if not (folder / "pipes.json").is_file():
        raise InputError(f"{folder} holds no pipes.json: give the --out of a replay or detect")
    file = read_pipes(folder / "pipes.json")
    has_poses = (folder / "trajectory.tum").is_file()
    nothing = np.empty(0, np.int64), np.empty((0, 4, 4))
    stamps, poses = read_trajectory(folder / "trajectory.tum") if has_poses else nothing
    return Results(
        folder=folder,
        pipes=file.pipes,
        classes=file.classes,
        runs=file.runs,
        planned=file.planned,
        walls_m2=file.walls_m2,
        scale=file.scale,
        facts=_facts(_mapping(folder / "run.json", read_json)),
        config=_mapping(folder / "config.yaml", read_yaml),
        stamps=stamps,
        map_from_camera=poses,
    )


def _rgb(text: str) -> Color:
    """RGB in 0..1 of `#rrggbb`."""
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red / 255, green / 255, blue / 255


def _palette(classes: list[dict[str, Any]]) -> dict[str, Color]:
    import matplotlib as mpl

    palette = mpl.color_sequences["tab10"]
    return {str(entry["class"]): tuple(palette[i % len(palette)]) for i, entry in enumerate(classes)}


def _cell(name: str, text: str) -> Any:
    """A cell of frames.csv as a value, None where it is empty."""
    if name in _TEXT_COLUMNS:
        return text
    if not text:
        return None
    if name in _YES_NO_COLUMNS:
        return bool(int(text))
    return int(text) if name in _WHOLE_COLUMNS else float(text)


def _mapping(path: Path, read: Callable[[Path], Any]) -> dict[str, Any]:
    """The mapping in a file that a run may lack, empty where there is none."""
    try:
        content = read(path)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}


def _facts(content: dict[str, Any]) -> dict[str, Any]:
    """The entries of run.json without those of another type than pipeprog writes."""
    return {key: value for key, value in content.items() if isinstance(value, _FACT_TYPES.get(key, object))}
