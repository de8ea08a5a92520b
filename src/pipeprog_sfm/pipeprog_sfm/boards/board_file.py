# SPDX-License-Identifier: Apache-2.0
"""The board file: the boards and scale bars on a site, and distances measured between boards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.file_kinds import kind_of
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.limits import MAX_BOARD_CIRCLES, MAX_CIRCLES, MAX_KNOWN_DISTANCES, MAX_TARGET_LENGTH
from pipeprog_camera.outside_text import name_of, nearest, shown
from pipeprog_sfm.boards.board import MIN_CIRCLES, Board, symmetries


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance between the centres of two circles.

    Attributes:
        name: for people.
        ends: name of the board and row of Board.centres, twice.
        length: m.
        sigma: standard deviation of `length`, m.
    """

    name: str
    ends: tuple[tuple[str, int], tuple[str, int]]
    length: float
    sigma: float


@dataclass(frozen=True)
class ScaleBar:
    """Two discs of one size, put up a measured distance apart; `marks` in the file.

    Attributes:
        name: for people.
        circle_radius: of both discs, m.
        length: distance between their centres, m.
        sigma: standard deviation of `length`, m.
    """

    name: str
    circle_radius: float
    length: float
    sigma: float

    @property
    def distance(self) -> KnownDistance:
        """The distance between the circles of `discs`."""
        one, two = self.discs
        return KnownDistance(self.name, ((one.name, 0), (two.name, 0)), self.length, self.sigma)

    @property
    def discs(self) -> tuple[Board, Board]:
        """Each disc as a board of one circle."""
        one, two = (Board(f"{self.name}/{end}", self.circle_radius, np.zeros((1, 3))) for end in (1, 2))
        return one, two


@dataclass(frozen=True)
class BoardFile:
    """Content of a board file: everything of known size; empty without a file.

    Attributes:
        boards: flat boards with circles.
        distances: measured between circles of boards.
        scale_bars: pairs of discs.
        path: of the file, for messages.
    """

    boards: Sequence[Board] = ()
    distances: Sequence[KnownDistance] = ()
    scale_bars: Sequence[ScaleBar] = ()
    path: str = "the board file"


def load_board_file(path: str | Path) -> BoardFile:
    """Reads a BOARD.yaml file with at least one board or scale bar.

    boards: [{name, circle_radius_mm, centres_mm: [[x, y], ...]}]
    distances: [{from: A/1, to: B/3, distance_mm, sigma_mm}], where `A/1` is the first circle of board A
    marks: [{circle_radius_mm, distance_mm, sigma_mm}]

    Raises:
        InputError: the file cannot be read, a key is missing or unknown, text stands where a number belongs, a length
            is not positive, a board has fewer than three circles, circles that overlap or lie on one line, a layout
            that looks the same turned by 120 degrees or less, or a name that is taken, a distance ends at a circle
            that is not in the file, or the discs of a scale bar overlap.
    """
    content = read_yaml(path)
    if isinstance(content, dict) and not {"boards", "marks"} & content.keys() and (kind := kind_of(content)):
        raise InputError(f"{path} is no board file: {kind}: are two files swapped?")
    keys = () if isinstance(content, dict) and "marks" in content else ("boards",)
    content = _entry(content, keys, str(path), optional=("boards", "distances", "marks"))
    entries = {key: content.get(key, []) for key in ("boards", "distances", "marks")}
    for key, rows in entries.items():
        if not isinstance(rows, list):
            raise InputError(f"{path}{line_of(content, key)}: '{key}' must be a list")
    if not entries["boards"] and not entries["marks"]:
        raise InputError(f"{path}: 'boards' must be a list with at least one board (or give a pair of 'marks')")
    _check_counts(path, entries)
    boards: list[Board] = []
    for number, entry in enumerate(entries["boards"], 1):
        board = _board(entry, f"{path}{line_of(entries['boards'], number - 1)}: board {number}")
        if board.name in [other.name for other in boards]:
            raise InputError(f"{path}: the name {shown(board.name)} is given to two boards: names must be unique")
        boards.append(board)
    distances = [
        _distance(entry, f"{path}{line_of(entries['distances'], number - 1)}: distance {number}", boards)
        for number, entry in enumerate(entries["distances"], 1)
    ]
    bars = [
        _scale_bar(entry, f"{path}{line_of(entries['marks'], number - 1)}: marks {number}", f"marks {number}")
        for number, entry in enumerate(entries["marks"], 1)
    ]
    return BoardFile(tuple(boards), tuple(distances), tuple(bars), str(path))


def _check_counts(path: str | Path, entries: Mapping[str, list[Any]]) -> None:
    """Refuses more circles or distances than a site has, before anything is computed of them."""
    rows = [entry.get("centres_mm") for entry in entries["boards"] if isinstance(entry, dict)]
    circles = sum(len(row) for row in rows if isinstance(row, list)) + 2 * len(entries["marks"])
    if max(circles, len(entries["boards"])) > MAX_CIRCLES:
        raise InputError(f"{path}: {max(circles, len(entries['boards']))} circles: give {MAX_CIRCLES} at most")
    if len(entries["distances"]) > MAX_KNOWN_DISTANCES:
        raise InputError(f"{path}: {len(entries['distances'])} distances: give {MAX_KNOWN_DISTANCES} at most")


def _distance(value: Any, where: str, boards: Sequence[Board]) -> KnownDistance:
    entry = _entry(value, ("from", "to", "distance_mm", "sigma_mm"), where)
    ends = []
    if not boards:
        raise InputError(f"{where}: distances lie between circles of boards, and the file has none: write it as marks")
    for key in ("from", "to"):
        end = name_of(entry[key], f"{where}: {key}")
        name, _, number = end.rpartition("/")
        count = next((len(board.centres) for board in boards if board.name == name), 0)
        if not number.isdecimal() or not 1 <= int(number) <= count:
            raise InputError(
                f"{where}: {shown(f'{key}: {end}')} is no circle of the file: write BOARD/NUMBER, such as "
                f"{shown(f'{boards[0].name}/1')} for the first circle of board {shown(boards[0].name)}"
            )
        ends.append((name, int(number) - 1))
    if ends[0] == ends[1]:
        raise InputError(f"{where}: both ends are {shown(entry['from'])}")
    length, sigma = _length(entry, where)
    return KnownDistance(f"{entry['from']} to {entry['to']}", (ends[0], ends[1]), length, sigma)


def _scale_bar(value: Any, where: str, name: str) -> ScaleBar:
    entry = _entry(value, ("circle_radius_mm", "distance_mm", "sigma_mm"), where)
    radius = _circle_radius(entry, where)
    length, sigma = _length(entry, where)
    if length <= 2 * radius:
        raise InputError(f"{where}: distance_mm = {1000 * length:g} is within the discs: measure between centres")
    return ScaleBar(name, radius, length, sigma)


def _length(entry: Mapping[str, Any], where: str) -> tuple[float, float]:
    """A measured distance and its standard deviation, m."""
    length, sigma = (_number(entry[key], f"{where}: {key}") for key in ("distance_mm", "sigma_mm"))
    if length <= 0 or sigma <= 0:
        raise InputError(f"{where}: distance_mm and sigma_mm must be above zero")
    return length / 1000, sigma / 1000


def _circle_radius(entry: Mapping[str, Any], where: str) -> float:
    """m"""
    radius = _number(entry["circle_radius_mm"], f"{where}: circle_radius_mm")
    if radius < 1.0:
        raise InputError(f"{where}: circle_radius_mm = {radius:g} is too small: give millimetres, 1 or more")
    return radius / 1000


def _entry(value: Any, keys: Sequence[str], where: str, optional: Sequence[str] = ()) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected the keys {', '.join(keys)}, found {shown(value)}")
    known = (*keys, *optional)
    for key in value:
        if key not in known:
            raise InputError(f"{where}: unknown key {shown(key)}, did you mean '{nearest(key, known)}'?")
    for key in keys:
        if key not in value:
            raise InputError(f"{where}: the key '{key}' is missing")
    return value


def _board(value: Any, where: str) -> Board:
    entry = _entry(value, ("name", "circle_radius_mm", "centres_mm"), where)
    name = name_of(entry["name"], f"{where}: the name")
    where = f"{where} ({shown(name)})"
    radius = 1000 * _circle_radius(entry, where)
    rows = entry["centres_mm"]
    if not isinstance(rows, list) or any(not isinstance(row, list) or len(row) != 2 for row in rows):
        raise InputError(f"{where}: centres_mm must be a list of [x, y] pairs in millimetres")
    if not MIN_CIRCLES <= len(rows) <= MAX_BOARD_CIRCLES:
        raise InputError(f"{where}: {len(rows)} circles, but a board needs {MIN_CIRCLES} to {MAX_BOARD_CIRCLES}")
    flat = np.array([[_number(number, f"{where}: centres_mm") for number in row] for row in rows])
    apart = np.linalg.norm(flat[:, None] - flat[None], axis=-1) + np.diag(np.full(len(flat), np.inf))
    if apart.min() <= 2 * radius:
        first, second = np.unravel_index(apart.argmin(), apart.shape)
        raise InputError(f"{where}: circles {first + 1} and {second + 1} overlap ({apart.min():g} mm apart)")
    if np.linalg.svd(flat - flat.mean(0), compute_uv=False)[1] < 2 * radius:
        raise InputError(f"{where}: the circles lie on one line: move one aside, so that the board has a plane")
    board = Board(name, radius / 1000, np.c_[flat, np.zeros(len(flat))] / 1000)
    turns = len(symmetries(board))
    if turns > 2:
        raise InputError(
            f"{where}: the layout looks the same {turns} ways round, and its circles cannot be told apart: move one"
        )
    return board


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(float(value)):
        raise InputError(f"{where}: {shown(value)} is not a number")
    if abs(value) > 1000 * MAX_TARGET_LENGTH:
        raise InputError(f"{where}: {value:g} is beyond any site: give millimetres")
    return float(value)
