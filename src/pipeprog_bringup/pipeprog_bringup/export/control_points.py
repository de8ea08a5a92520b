# SPDX-License-Identifier: Apache-2.0
"""Control points: where the site's coordinates lie in the map, how well they agree, and which point is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.export.survey import Site
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CONTROL_POINTS, MAX_COORDINATE
from pipeprog_camera.outside_text import name_of, nearest, shown
from pipeprog_camera.similarity import similarity
from pipeprog_camera.yaml_file import line_of, read_yaml

_KEYS = ("name", "circle", "pixel", "xyz")
_LEAST = 3  # points fix a rigid transform, where they are not in line
_FLAT = 0.05  # of the extent, across the line that points lie nearly on; less leaves the turn about it open
# A point is wrong that lies this many times further off than the others are among each other, which is no better than
# 3 mm: a total station's 2 mm and as much of the map.
_WRONG, _NOISE = 5.0, 0.003


@dataclass(frozen=True)
class ControlPoint:
    """A point of known site coordinates (3,) [m], shown by a circle of a board or by pixels of keyframes.

    circle is `BOARD/NUMBER` or empty; pixels are rows of keyframe (from 1), u, v [px].
    """

    name: str
    xyz: FloatArray
    circle: str = ""
    pixels: tuple[tuple[int, float, float], ...] = ()


@dataclass(frozen=True)
class ControlPointFile:
    """Content of a POINTS.yaml: the points, and the name of their coordinate reference system or an empty text."""

    points: tuple[ControlPoint, ...]
    crs: str = ""


@dataclass(frozen=True)
class Alignment:
    """The site, the distance (N,) of each point from its place [m], and metres of the points in a metre of the map."""

    site: Site
    residuals: FloatArray
    scale: float


def load_control_points(path: Path) -> ControlPointFile:
    """Reads POINTS.yaml: `points: [{name, circle or pixel, xyz}]` and optionally `crs`.

    Raises InputError, naming the file, the value and the remedy, for anything else.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not isinstance(content.get("points"), list):
        raise InputError(f"{path}: holds no list 'points': write points: [{{name: P1, circle: A/1, xyz: [x, y, z]}}]")
    for key in content:
        if key not in ("points", "crs"):
            raise InputError(f"{path}: unknown key {shown(key)}: did you mean '{nearest(key, ('points', 'crs'))}'?")
    entries = content["points"]
    if not _LEAST <= len(entries) <= MAX_CONTROL_POINTS:
        raise InputError(
            f"{path}: {len(entries)} points: give {_LEAST} to {MAX_CONTROL_POINTS}, four or more tell errors"
        )
    points: list[ControlPoint] = []
    for number, entry in enumerate(entries):
        point = _point(entry, f"{path}{line_of(entries, number)}: point {number + 1}")
        if any(other.name == point.name for other in points):
            raise InputError(f"{path}{line_of(entries, number)}: the name {shown(point.name)} is given to two points")
        points.append(point)
    crs = name_of(content["crs"], f"{path}: crs") if "crs" in content else ""
    return ControlPointFile(tuple(points), crs)


def align(points: ControlPointFile, in_map: FloatArray) -> Alignment:
    """The site's coordinates from places (N, 3) of the points in the map [m]; lengths stay those of the map.

    Raises InputError where the points lie nearly in line or do not agree; it names the wrong one where one is.
    """
    xyz = np.array([point.xyz for point in points.points])
    extent = np.linalg.svd(in_map - in_map.mean(axis=0), compute_uv=False)
    if extent[1] < _FLAT * extent[0]:
        raise InputError(
            "the control points lie nearly in line, which leaves the turn about it open: add one beside it"
        )
    site_from_map, residuals = _fit(in_map, xyz)
    if residuals.max() > _WRONG * _NOISE:
        _name_wrong(points.points, in_map, xyz, residuals)
    scale = float(np.cbrt(np.linalg.det(similarity(in_map, xyz)[:3, :3])))
    return Alignment(Site(site_from_map, points.crs), residuals, scale)


def _fit(in_map: FloatArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rigid transform (4, 4) of least squares, and the points' distances (N,) from where it puts them [m]."""
    transform = similarity(in_map, xyz, scaled=False)
    return transform, np.linalg.norm(in_map @ transform[:3, :3].T + transform[:3, 3] - xyz, axis=1)


def _name_wrong(points: Sequence[ControlPoint], in_map: FloatArray, xyz: FloatArray, residuals: FloatArray) -> None:
    """Raises InputError: with the point without which the others agree, or with the distances of all."""
    found = []
    for index in range(len(points)) if len(points) > _LEAST else ():
        others = np.arange(len(points)) != index
        transform, among = _fit(in_map[others], xyz[others])
        off = float(np.linalg.norm(transform[:3, :3] @ in_map[index] + transform[:3, 3] - xyz[index]))
        rms = float(np.sqrt((among**2).mean()))
        found.append((rms, index, off))
    if found:
        rms, index, off = min(found)
        if rms < 2.0 * _NOISE and off > _WRONG * max(rms, _NOISE):
            raise InputError(
                f"control point {shown(points[index].name)} lies {1e3 * off:.0f} mm from where the others put it; they "
                f"agree to {1e3 * rms:.1f} mm: measure it again, check its name and numbers, or leave it out"
            )
    told = ", ".join(f"{point.name} {1e3 * one:.0f} mm" for point, one in zip(points, residuals, strict=True))
    raise InputError(
        f"the control points do not agree with the map ({told}): check names and numbers, and add points until the "
        "wrong one shows"
    )


def _point(entry: Any, where: str) -> ControlPoint:
    if not isinstance(entry, dict) or "name" not in entry or "xyz" not in entry:
        raise InputError(f"{where} is {shown(entry)}: write name, xyz, and circle or pixel")
    for key in entry:
        if key not in _KEYS:
            raise InputError(f"{where}: unknown key {shown(key)}: did you mean '{nearest(key, _KEYS)}'?")
    if ("circle" in entry) == ("pixel" in entry):
        raise InputError(f"{where} needs either circle or pixel")
    name, xyz = name_of(entry["name"], f"{where}: name"), _numbers(entry["xyz"], 3, f"{where}: xyz")
    if "circle" in entry:
        return ControlPoint(name, xyz, circle=name_of(entry["circle"], f"{where}: circle"))
    rows = entry["pixel"]
    if not isinstance(rows, list) or len(rows) < 2:
        raise InputError(f"{where}: pixel is {shown(rows)}: give [keyframe, u, v] in two keyframes or more")
    seen = []
    for row in rows:
        keyframe, u, v = _numbers(row, 3, f"{where}: pixel")
        seen.append((int(keyframe), float(u), float(v)))
    return ControlPoint(name, xyz, pixels=tuple(seen))


def _numbers(value: Any, count: int, where: str) -> FloatArray:
    good = isinstance(value, list) and len(value) == count
    if not good or not all(isinstance(one, int | float) and abs(one) <= MAX_COORDINATE for one in value):
        raise InputError(f"{where} is {shown(value)}: write {count} numbers in metres or pixels, with a decimal point")
    return np.array(value, float)
