# SPDX-License-Identifier: Apache-2.0
"""Control points: where the site's coordinates lie in the map, how well they agree, and which point is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from pipeprog_bringup.export.survey import Site
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.limits import MAX_CONTROL_POINTS, MAX_COORDINATE
from pipeprog_camera.outside_text import name_of, nearest, shown
from pipeprog_camera.similarity import similarity

_KEYS = ("name", "circle", "pixel", "xyz")
_LEAST = 3  # points fix a rigid transform, where they are not in line
_FLAT = 0.05  # of the extent, across the line that points lie nearly on; less leaves the turn about it open
_NOISE = 0.003  # m in each axis, of a point against its place in the map: a total station's 2 mm and as much of the map
_LEVEL = 0.02  # probability with which points that are off by _NOISE alone fail a test
# Times likelier that the errors must be with one point wrong than with another; with less, both are told.
_ODDS = 10.0
_FAR = 0.02  # m; nothing is refused for a point nearer than this, the tolerance that planned pipes have
_WORST = 5.0 * _NOISE  # a fit that leaves a point this far off is refused, though no point is to blame by itself
_DOUBTED = 3.0 * _NOISE  # a point further off is warned of: noise alone takes fewer than 3 of 100 points as far
_UPRIGHT = np.cos(np.radians(10.0))  # z of the map and of the site, both up: a board's, or that of walls, errs by less
_SWAPPED, _MIRRORED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), np.diag([1, 1, -1])
# What programs of other countries write: northing before easting, depths in place of heights. Mirrored easting is
# swapped axes turned about z.
_MISREAD = {
    "easting and northing are swapped, or one of them has the wrong sign": _SWAPPED,
    "the heights have the wrong sign": _MIRRORED,
    "easting and northing are swapped, and the heights have the wrong sign": _SWAPPED @ _MIRRORED,
}


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
    """Where the site's coordinates lie in the map.

    Attributes:
        site: the transform, and the name of the coordinate reference system.
        residuals: distance (N,) of each point from where the fit of all puts it [m].
        scale: metres of the points in a metre of the map.
        warning: which points a person should check, a full sentence, or an empty text.
    """

    site: Site
    residuals: FloatArray
    scale: float
    warning: str = ""


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

    Raises InputError where the points lie nearly in line, where axes are swapped or mirrored, and where the points do
    not agree; it names the wrong point where one is.
    """
    xyz = np.array([point.xyz for point in points.points])
    if _nearly_in_line(in_map):
        raise InputError(
            "the control points lie nearly in line, which leaves the turn about it open: add one beside it"
        )
    site_from_map, residuals = _fit(in_map, xyz)
    if not _fits(site_from_map, residuals):
        _name_misread_axes(in_map, xyz)
    _name_wrong(points.points, in_map, xyz, residuals)
    if residuals.max() > _WORST:
        raise InputError(
            f"the control points do not agree with the map ({_distances(points.points, residuals)}): check names and "
            "numbers, and add points until the wrong one shows"
        )
    scale = float(np.cbrt(np.linalg.det(similarity(in_map, xyz)[:3, :3])))
    return Alignment(Site(site_from_map, points.crs), residuals, scale, _doubt(points.points, residuals))


def _nearly_in_line(places: FloatArray) -> bool:
    extent = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(extent[1] < _FLAT * extent[0])


def _fit(in_map: FloatArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rigid transform (4, 4) of least squares, and the points' distances (N,) from where it puts them [m]."""
    transform = similarity(in_map, xyz, scaled=False)
    return transform, np.linalg.norm(in_map @ transform[:3, :3].T + transform[:3, 3] - xyz, axis=1)


def _fits(site_from_map: FloatArray, residuals: FloatArray) -> bool:
    """Whether the points agree and the map is upright: mirrored points in one plane agree with the map upside down."""
    return bool(residuals.max() <= _WORST and site_from_map[2, 2] > _UPRIGHT)


def _name_misread_axes(in_map: FloatArray, xyz: FloatArray) -> None:
    """Raises InputError where the points fit with other axes."""
    for what, axes in _MISREAD.items():
        site_from_map, residuals = _fit(in_map, xyz @ axes)
        if _fits(site_from_map, residuals):
            raise InputError(
                f"the control points do not fit the map as they are, but to {1e3 * residuals.max():.0f} mm where "
                f"{what}: write xyz as easting, northing, height"
            )


def _name_wrong(points: Sequence[ControlPoint], in_map: FloatArray, xyz: FloatArray, residuals: FloatArray) -> None:
    """Raises InputError, naming it, where the points agree without one of them, which is far off.

    A fit of all spreads the error of one point over all of them: of four, one that is 50 mm wrong may leave less than
    10 mm. Each point is therefore left out in turn. What the sum of squares then loses has 3 degrees of freedom
    (Baarda's data snooping), and what is left of it 3 for each of the other points, less the 6 of the fit.
    """
    count, total, suspects = len(points), float((residuals**2).sum()), []
    for index in range(count) if count > _LEAST else ():
        others = np.arange(count) != index
        transform, among = _fit(in_map[others], xyz[others])
        left = float((among**2).sum())
        if left > _NOISE**2 * chdtri(3 * count - 9, _LEVEL) or total - left < _NOISE**2 * chdtri(3, _LEVEL):
            continue
        # The others leave a turn open where they lie in line: the point is wrong, but no distance is known.
        off = float(np.linalg.norm(transform[:3, :3] @ in_map[index] + transform[:3, 3] - xyz[index]))
        off = np.inf if _nearly_in_line(in_map[others]) else off
        if off > _FAR:
            suspects.append((left, points[index].name, off))
    if not suspects:
        return
    least = min(suspects)[0]
    suspects = [one for one in sorted(suspects) if one[0] - least < 2.0 * _NOISE**2 * np.log(_ODDS)]
    left, name, off = suspects[0]
    if len(suspects) == 1 and np.isfinite(off):
        raise InputError(
            f"control point {shown(name)} lies {1e3 * off:.0f} mm from where the others put it; they agree to "
            f"{1e3 * (left / (count - 1)) ** 0.5:.1f} mm: measure it again, check its name and numbers, or leave it out"
        )
    names = " or ".join(shown(name) for _, name, _ in suspects)
    raise InputError(
        f"control point {names} is wrong, without which the others agree: measure again, check names and numbers, or "
        "add a point that is not in line with others"
    )


def _doubt(points: Sequence[ControlPoint], residuals: FloatArray) -> str:
    """A sentence on the points that are further off than noise explains, or an empty text."""
    doubted = [index for index in range(len(points)) if residuals[index] > _DOUBTED]
    if not doubted:
        return ""
    told = _distances([points[index] for index in doubted], residuals[doubted])
    remedy = "a fourth point would tell which is wrong" if len(points) == _LEAST else "check them"
    return f"control points lie further off than {1e3 * _DOUBTED:.0f} mm, three times their noise ({told}): {remedy}"


def _distances(points: Sequence[ControlPoint], residuals: FloatArray) -> str:
    return ", ".join(f"{point.name} {1e3 * one:.0f} mm" for point, one in zip(points, residuals, strict=True))


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
