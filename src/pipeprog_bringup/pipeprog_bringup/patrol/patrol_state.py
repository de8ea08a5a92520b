# SPDX-License-Identifier: Apache-2.0
"""Where a patrol stands, on disk: what is surveyed stays so when the program is started again."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.outside_text import shown

OPEN, FILMING, DONE, FAILED = "open", "filming", "done", "failed"


@dataclass
class PlaceState:
    """What became of a place.

    Attributes:
        state: `open`; `filming` (after a start anew: the program was killed meanwhile); `done`; or `failed`.
        attempts: surveys begun, whose names end in _2, _3, ... from the second on.
        survey_id: of the last survey.
        folder: with its results, as the node survey has named it; empty: none.
        error: why it failed.
    """

    state: str = OPEN
    attempts: int = 0
    survey_id: str = ""
    folder: str = ""
    error: str = ""


class PatrolState:
    """The places of a patrol by name; `save` writes them, all or nothing."""

    def __init__(self, path: Path, names: list[str]) -> None:
        """Reads `path` where it exists; raises InputError where it is no state of a patrol."""
        self._path = path
        known = _read(path) if path.exists() else {}
        # Places that the file has no more are kept: their folders are there.
        self.places = {name: known.get(name, PlaceState()) for name in [*names, *(set(known) - set(names))]}

    def save(self) -> None:
        """Replaces the file at once: after a loss of power it is the old one or the new one."""
        content = {"places": {name: asdict(place) for name, place in self.places.items()}}
        part = self._path.with_name(f"{self._path.name}.part")
        with part.open("w") as stream:
            json.dump(content, stream, indent=1)
            stream.write("\n")
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(self._path)


def _read(path: Path) -> dict[str, PlaceState]:
    content = read_json(path)
    places = content.get("places") if isinstance(content, dict) else None
    if not isinstance(places, dict):
        raise InputError(f"{path}: is no state of a patrol: choose another --out, or remove it to begin anew")
    return {str(name): _place(path, str(name), entry) for name, entry in places.items()}


def _place(path: Path, name: str, entry: Any) -> PlaceState:
    kinds = {field.name: int if field.name == "attempts" else str for field in fields(PlaceState)}
    fits = isinstance(entry, dict) and all(key in kinds and isinstance(entry[key], kinds[key]) for key in entry)
    if not fits or entry.get("state", OPEN) not in (OPEN, FILMING, DONE, FAILED) or entry.get("attempts", 0) < 0:
        raise InputError(f"{path}: place {shown(name)} is {shown(entry)}: remove the file to begin anew")
    return PlaceState(**entry)
