# SPDX-License-Identifier: Apache-2.0
"""PATROL.yaml: the places of a patrol, how the robot gets there, and how it films."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.outside_text import name_of, nearest, shown

MAX_PLACES = 1000  # of a patrol; a night of 12 hours has 700 minutes
MAX_WORDS = 100  # of a command; programs of this kind take ten arguments
MAX_SECONDS = 86400.0  # s; a day, as a survey's own limit
MOVE_SECONDS = 600.0  # s for a command that moves the robot; half a kilometre at a walk
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")  # leaves room in a survey's 64 characters for the patrol's name
_SHARED = ("boq", "board", "reference", "go_to", "film", "seconds", "move_seconds")
_PLACE = "{place}"  # stands for the name of the place in a command, and in the name of a reference


@dataclass(frozen=True)
class Place:
    """A place that is surveyed.

    Attributes:
        name: of the place.
        go_to: command that takes the robot there, words; empty: it is there already.
        film: command that walks the robot past the pipes: filming ends with it; empty: the robot films for `seconds`.
        seconds: of filming at most, 0: until `film` has ended.
        move_seconds: of either command at most.
        boq: file of the bill of quantities; empty: as the node survey has it.
        board: file of the boards; empty: as the node survey has it.
        reference: survey in whose frame this one is to lie, as the node survey takes it; empty: none.
    """

    name: str
    go_to: tuple[str, ...] = ()
    film: tuple[str, ...] = ()
    seconds: float = 0.0
    move_seconds: float = MOVE_SECONDS
    boq: str = ""
    board: str = ""
    reference: str = ""


@dataclass(frozen=True)
class Patrol:
    """Places in their order, and the command that takes the robot home, empty: it stays at the last one."""

    places: tuple[Place, ...]
    home: tuple[str, ...] = ()


def read_patrol(path: Path) -> Patrol:
    """The patrol of a file; raises InputError, naming the file, the line and the remedy, for what is none."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no mapping: a patrol begins with 'places:'")
    _refuse_unknown(str(path), content, ("places", "home", *_SHARED))
    entries = content.get("places")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}{line_of(content, 'places')}: places is {shown(entries)}: list at least one")
    if len(entries) > MAX_PLACES:
        raise InputError(f"{path}: {len(entries)} places: write {MAX_PLACES} at most, or make two patrols of it")
    shared = {key: content[key] for key in _SHARED if key in content}
    places = [_place(path, f"{path}{line_of(entries, number)}", entry, shared) for number, entry in enumerate(entries)]
    seen: set[str] = set()
    for number, place in enumerate(places):
        if place.name in seen:
            raise InputError(f"{path}{line_of(entries, number)}: the place {shown(place.name)} stands above already")
        seen.add(place.name)
    return Patrol(tuple(places), _command(f"{path}: home", content.get("home")))


def _place(path: Path, where: str, entry: Any, shared: dict[str, Any]) -> Place:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: a place is {shown(entry)}: write `- name: level2`, and its keys below each other")
    _refuse_unknown(where, entry, ("name", *_SHARED))
    name = name_of(entry.get("name"), f"{where}: name")
    if not _NAME.fullmatch(name):
        raise InputError(f"{where}: name {shown(name)}: it names a folder: use up to 40 letters, digits, . - and _")
    given = {**shared, **entry}
    go_to, film = (
        tuple(word.replace(_PLACE, name) for word in _command(f"{where}: {key}", given.get(key)))
        for key in ("go_to", "film")
    )
    seconds = _seconds(f"{where}: seconds", given.get("seconds", 0.0))
    if not film and not seconds:
        raise InputError(f"{where}: when does filming end? give `film`, a command that walks the robot, or `seconds`")
    move_seconds = _seconds(f"{where}: move_seconds", given.get("move_seconds", MOVE_SECONDS))
    boq, board = (_file(path, f"{where}: {key}", given.get(key)) for key in ("boq", "board"))
    reference = name_of(given["reference"], f"{where}: reference") if "reference" in given else ""
    reference = reference.replace(_PLACE, name)
    return Place(name, go_to, film, seconds, move_seconds or MOVE_SECONDS, boq, board, reference)


def _command(where: str, words: Any) -> tuple[str, ...]:
    """The words of a command; no shell reads it."""
    if words is None:
        return ()
    is_list = isinstance(words, list) and 0 < len(words) <= MAX_WORDS
    if not is_list or not all(isinstance(word, str | int | float) and str(word) for word in words):
        raise InputError(f"{where} is {shown(words)}: write program and arguments as a list: [ros2, run, ...]")
    return tuple(str(word) for word in words)


def _seconds(where: str, value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value <= MAX_SECONDS:
        raise InputError(f"{where} is {shown(value)}: give seconds, 0 to {MAX_SECONDS:g}")
    assert math.isfinite(value)
    return float(value)


def _file(path: Path, where: str, value: Any) -> str:
    """An absolute path; relative ones are to the patrol's folder, since the node survey runs elsewhere."""
    if value is None:
        return ""
    return str((path.parent / name_of(value, where)).resolve())


def _refuse_unknown(where: str, content: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            raise InputError(f"{where}: unknown key {shown(key)}: did you mean '{nearest(key, known)}'?")
