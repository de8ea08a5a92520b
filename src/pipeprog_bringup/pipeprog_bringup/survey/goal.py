# SPDX-License-Identifier: Apache-2.0
"""What a survey is asked to do, checked before anything of it begins."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # a folder's name on every file system, and no path
MAX_TIME = 86400.0  # s; a day: no battery films longer
_MAX_PATH = 4096  # characters, as Linux has it


@dataclass(frozen=True)
class Site:
    """The files of a survey, read: the bill of quantities and the boards."""

    boq_path: Path
    boq: BillOfQuantities
    board_path: Path | None
    board_file: BoardFile


@dataclass(frozen=True)
class Reference:
    """An earlier survey in whose frame one is to lie: its map.npz, and what that holds."""

    path: Path
    map: SurveyMap


@dataclass(frozen=True)
class Goal:
    """A survey that can begin. `name`: of its folder; `time_limit` [s], 0: none."""

    name: str
    site: Site
    time_limit: float
    reference: Reference | None = None


def read_site(boq: str, board: str) -> Site:
    """Reads the files that a goal or the parameters name; raises InputError."""
    boq_path, board_path = _path("boq", boq), _path("board", board) if board else None
    board_file = load_board_file(board_path) if board_path else BoardFile()
    return Site(boq_path, load_boq(boq_path), board_path, board_file)


def _check_name(name: str) -> str:
    """The name of a survey's folder, as it is; raises InputError for one that could lead elsewhere."""
    if name and not _NAME.fullmatch(name):
        raise InputError(
            f"survey_id {shown(name)}: it names a folder: use up to 64 letters, digits, dots, dashes and underscores"
        )
    return name


def check_goal(survey_id: str, site: Site, time_limit: float, now: int) -> Goal:
    """A goal of these fields, given at the time `now` [ns]; raises InputError where one cannot be used."""
    name = _check_name(survey_id) or _name_from_time(now)
    if not 0.0 <= time_limit <= MAX_TIME:
        raise InputError(f"time_limit {time_limit:g} s: give 0 (none) to {MAX_TIME:g} s")
    return Goal(name, site, time_limit)


def read_reference(text: str, results: Path) -> Reference:
    """The survey that a goal names, by the name of its folder in `results` or by an absolute path.

    Raises InputError where that is none, or holds no map.
    """
    folder = text.removeprefix("file://")
    if "\0" in folder or len(folder) > _MAX_PATH or not (_NAME.fullmatch(folder) or folder.startswith("/")):
        raise InputError(
            f"reference {shown(text)}: name a survey's folder in {results}, or give the absolute path of one"
        )
    path = (results / folder / MAP_FILE).resolve()
    try:
        return Reference(path, read_map(path))
    except InputError as error:
        raise InputError(f"reference {shown(text)}: {error}") from None


def _name_from_time(stamp: int) -> str:
    """Name of a survey that begins at this time [ns]."""
    moment = datetime.fromtimestamp(stamp // 10**9, timezone.utc)
    return f"survey_{moment:%Y%m%dT%H%M%SZ}"


def _path(key: str, text: str) -> Path:
    path = text.removeprefix("file://")
    if "://" in path or "\0" in path or len(path) > _MAX_PATH:
        raise InputError(f"{key} {shown(text)}: give the path of a file on this machine")
    if not path:
        raise InputError(f"no {key}: name its file in the goal, or in the parameter {key} of the node survey")
    return Path(path)
