# SPDX-License-Identifier: Apache-2.0
"""The bill of quantities: which pipe classes are planned, how thick, how many metres."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLASSES, MAX_PIPE_LENGTH, MAX_PIPE_RADIUS, MIN_PIPE_RADIUS
from pipeprog_camera.outside_text import name_of, nearest, shown
from pipeprog_camera.yaml_file import line_of, read_yaml
from pipeprog_detect.product.standard_sizes import find_size, nearest_name

Color = tuple[float, float, float]

# Outer radius is toleranced to about half a percent of the diameter either way (EN 10220), and paint adds to it.
_RELATIVE_TOLERANCE = 0.01
_LEAST_TOLERANCE = 1e-4

# Names without matplotlib's values, and at once; its other names of CSS are taken, too.
NAMED_COLORS: dict[str, Color] = {
    "black": (0.0, 0.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "brown": (0.65, 0.16, 0.16),
    "cyan": (0.0, 1.0, 1.0),
    "gray": (0.5, 0.5, 0.5),
    "green": (0.0, 0.5, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "lime": (0.0, 1.0, 0.0),
    "magenta": (1.0, 0.0, 1.0),
    "maroon": (0.5, 0.0, 0.0),
    "navy": (0.0, 0.0, 0.5),
    "olive": (0.5, 0.5, 0.0),
    "orange": (1.0, 0.65, 0.0),
    "pink": (1.0, 0.75, 0.8),
    "purple": (0.5, 0.0, 0.5),
    "red": (1.0, 0.0, 0.0),
    "silver": (0.75, 0.75, 0.75),
    "teal": (0.0, 0.5, 0.5),
    "white": (1.0, 1.0, 1.0),
    "yellow": (1.0, 1.0, 0.0),
}
# Colours by outer radius [m] of the paper's Figure 11, then others told apart from them.
_FIGURE_11 = {0.0086: "magenta", 0.0365: "blue", 0.0575: "cyan", 0.0841: "green", 0.1095: "red", 0.1223: "yellow"}
_OTHERS = ("orange", "purple", "lime", "brown", "teal", "pink", "navy", "olive", "maroon", "silver")

# Sewer pipes of PVC (EN 1401) have walls of a 34th to a 41st of the diameter; half of the range is two standard
# deviations of the bore's radius. A bill of quantities of sewers may also give the bores themselves as its sizes: these
# are made to half a percent.
_WALL_SHARE, _WALL_SPREAD = 0.5 * (2 / 34 + 2 / 41), 0.004
_BORE_TOLERANCE = 0.005

_SIZE_KEYS = ("outer_radius_mm", "outer_diameter_mm", "size")
_KEYS = ("name", *_SIZE_KEYS, "wall_mm", "planned_length_m", "color")


@dataclass(frozen=True)
class PipeClass:
    """A planned class: outer radius and its tolerance (one standard deviation) [m], planned length [m], RGB in 0..1.

    wall [m] is the thickness of its wall, None where it is not given; a camera inside sees the bore.
    """

    name: str
    outer_radius: float
    planned_length: float
    color: Color
    tolerance: float
    wall: float | None = None

    @property
    def bores(self) -> tuple[tuple[float, float], ...]:
        """Radii that its inner surface may have, and their tolerances (one standard deviation) [m]."""
        if self.wall is not None:
            return ((self.outer_radius - self.wall, self.tolerance),)
        return (
            (self.outer_radius * (1.0 - _WALL_SHARE), self.outer_radius * _WALL_SPREAD),
            (self.outer_radius, self.outer_radius * _BORE_TOLERANCE),
        )


@dataclass(frozen=True)
class BillOfQuantities:
    """The planned classes, in the order of the file."""

    classes: tuple[PipeClass, ...]

    @classmethod
    def of_radii(cls, radii: Mapping[str, float]) -> BillOfQuantities:
        """Classes by their outer radii [m] alone: planned lengths are not known (nan).

        Raises InputError where there is no class or a radius is no length.
        """
        classes = [
            PipeClass(name, radius, math.nan, (0.5, 0.5, 0.5), max(_RELATIVE_TOLERANCE * radius, _LEAST_TOLERANCE))
            for name, radius in radii.items()
            if _positive(f"radii: class {shown(name)}", "the outer radius in metres", radius)
        ]
        if not classes:
            raise InputError("radii: no class is given: name at least one planned outer radius in metres")
        return cls(_with_colors(classes, [None] * len(classes)))


def load_boq(path: str | Path) -> BillOfQuantities:
    """Read BOQ.yaml (`classes:` with name, planned_length_m, color and a size).

    The size is outer_radius_mm, outer_diameter_mm or `size`, a standard one such as `DN50 steel` (see sizes).

    Raises InputError, naming the file, the value and the remedy, for anything that is no bill of quantities.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no mapping: a bill of quantities begins with 'classes:'")
    _refuse_unknown(str(path), "the file", content, ("classes",))
    entries = content.get("classes")
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path}{line_of(content, 'classes')}: classes is {shown(entries)}: "
            "list at least one class with name, radius and planned length"
        )
    if len(entries) > MAX_CLASSES:
        raise InputError(f"{path}: {len(entries)} classes: plan {MAX_CLASSES} at most, or split the bill by trades")
    classes: list[PipeClass] = []
    colors: list[Color | None] = []
    for number, entry in enumerate(entries):
        where = f"{path}{line_of(entries, number)}"
        new = _read_class(where, number + 1, entry)
        _refuse_double(where, new, classes)
        classes.append(new)
        colors.append(_read_color(f"{where}: class {shown(new.name)}", entry["color"]) if "color" in entry else None)
    return BillOfQuantities(_with_colors(classes, colors))


def _refuse_double(where: str, new: PipeClass, classes: list[PipeClass]) -> None:
    for old in classes:
        if old.name == new.name:
            raise InputError(
                f"{where}: class {shown(new.name)} is listed twice: keep one, or give the other its own name"
            )
        if math.isclose(old.outer_radius, new.outer_radius, rel_tol=1e-6):
            raise InputError(
                f"{where}: classes {shown(old.name)} and {shown(new.name)} have the same outer radius "
                f"{1e3 * new.outer_radius:g} mm and cannot be told apart: merge them"
            )


def _read_class(where: str, number: int, entry: object) -> PipeClass:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: class {number} is {shown(entry)}: write name, outer_radius_mm and planned_length_m")
    if "name" not in entry:
        raise InputError(f"{where}: class {number} has no name: give each class a name")
    name = name_of(entry["name"], f"{where}: the name of class {number}")
    _refuse_unknown(where, f"class {shown(name)}", entry, _KEYS)
    where = f"{where}: class {shown(name)}"
    radius, tolerance = _read_size(where, entry)
    if not MIN_PIPE_RADIUS <= radius <= MAX_PIPE_RADIUS:
        raise InputError(f"{where}: an outer radius of {radius:g} m is that of no pipe: write millimetres")
    if "planned_length_m" not in entry:
        raise InputError(f"{where} has no planned_length_m: give the metres that are planned")
    length = _positive(where, "planned_length_m", entry["planned_length_m"])
    if length > MAX_PIPE_LENGTH:
        raise InputError(f"{where}: planned_length_m is {length:g}: write metres, {MAX_PIPE_LENGTH:g} at most")
    wall = 1e-3 * _positive(where, "wall_mm", entry["wall_mm"]) if "wall_mm" in entry else None
    if wall is not None and wall >= radius:
        raise InputError(f"{where}: wall_mm is {1e3 * wall:g}, more than the radius: write the wall's thickness")
    return PipeClass(name, radius, length, (0.5, 0.5, 0.5), tolerance, wall)


def _read_size(where: str, entry: dict[str, object]) -> tuple[float, float]:
    """Outer radius and its tolerance [m]."""
    given = [key for key in _SIZE_KEYS if key in entry]
    if len(given) != 1:
        raise InputError(
            f"{where} needs one of {', '.join(_SIZE_KEYS)}, not {' and '.join(given) if given else 'none'}"
        )
    value = entry[given[0]]
    if given[0] == "size":
        text = name_of(value, f"{where}: size")
        size = find_size(text)
        if size is None:
            raise InputError(f"{where}: unknown size {shown(text)}: did you mean '{nearest_name(text)}'?")
        return 0.5 * size.outer_diameter, 0.5 * size.tolerance
    millimetres = _positive(where, given[0], value)
    radius = 1e-3 * millimetres * (1.0 if given[0] == "outer_radius_mm" else 0.5)
    return radius, max(_RELATIVE_TOLERANCE * radius, _LEAST_TOLERANCE)


def _positive(where: str, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key} is {shown(value)}: write a number")
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{where}: {key} is {shown(value)}: write a number above zero")
    return float(value)


def _refuse_unknown(where: str, what: str, entry: dict[object, object], known: tuple[str, ...]) -> None:
    for key in entry:
        if key not in known:
            raise InputError(f"{where}: unknown key {shown(key)} in {what}: did you mean '{nearest(key, known)}'?")


def _with_colors(classes: list[PipeClass], given: list[Color | None]) -> tuple[PipeClass, ...]:
    """The classes with the colours that are given (None: by outer radius, else one that tells them apart)."""
    colors: list[Color | None] = []
    for new, color in zip(classes, given, strict=True):
        known = [name for radius, name in _FIGURE_11.items() if abs(radius - new.outer_radius) < 2e-4]
        colors.append(color or (NAMED_COLORS[known[0]] if known else None))
    spare = [NAMED_COLORS[name] for name in _OTHERS if NAMED_COLORS[name] not in colors]
    missing = 0
    done = []
    for new, color in zip(classes, colors, strict=True):
        if color is None:
            color = spare[missing % len(spare)]
            missing += 1
        done.append(replace(new, color=color))
    return tuple(done)


def _read_color(where: str, value: object) -> Color:
    text = name_of(value, f"{where}: color").lower()
    if text in NAMED_COLORS:
        return NAMED_COLORS[text]
    if re.fullmatch(r"#[0-9a-f]{6}", text):
        return (int(text[1:3], 16) / 255, int(text[3:5], 16) / 255, int(text[5:7], 16) / 255)
    from matplotlib.colors import CSS4_COLORS, to_rgb  # a quarter of a second that only other names need

    if text in CSS4_COLORS:
        red, green, blue = to_rgb(text)
        return (red, green, blue)
    near = nearest(text, [*NAMED_COLORS, *CSS4_COLORS])
    raise InputError(f"{where}: unknown color {shown(text)}: did you mean '{near}'? #rrggbb is fine too")
