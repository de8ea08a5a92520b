# SPDX-License-Identifier: Apache-2.0
"""The bill of quantities: which pipe classes are planned, how thick, how many metres, and where if it says so."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from itertools import combinations
from pathlib import Path

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLASSES, MAX_NAME, MAX_PIPE_LENGTH, MAX_PIPE_RADIUS, MIN_PIPE_RADIUS
from pipeprog_camera.outside_text import name_of, nearest, shown
from pipeprog_detect.plan.entry import LEAST_RADIUS_STEP, Entry, Segment
from pipeprog_detect.plan.materials import MATERIALS, read_material
from pipeprog_detect.plan.plan_file import read_plan
from pipeprog_detect.product.class_colors import Color, distinct_colors, read_color
from pipeprog_detect.product.standard_sizes import find_size, nearest_name
from pipeprog_detect.product.unit_check import WrittenSize, ask_about_length, ask_about_units
from pipeprog_detect.types import Cylinder

# Outer radius is toleranced to about half a percent of the diameter either way (EN 10220), and paint adds to it.
_RELATIVE_TOLERANCE = 0.01
_LEAST_TOLERANCE = 1e-4

# Sewer pipes of PVC (EN 1401) have walls of a 34th to a 41st of the diameter; half of the range is two standard
# deviations of the bore's radius. A bill of quantities of sewers may also give the bores themselves as its sizes: these
# are made to half a percent.
_WALL_SHARE, _WALL_SPREAD = 0.5 * (2 / 34 + 2 / 41), 0.004
_BORE_TOLERANCE = 0.005

_NO_COLOR: Color = (0.5, 0.5, 0.5)  # until all classes are known
_SIZE_KEYS = ("outer_radius_mm", "outer_diameter_mm", "size")
_LINE_KEYS = ("system", "zone", "activity")  # these tell lines of one size apart
_DATE_KEYS = ("start", "finish")
_KEYS = ("name", *_SIZE_KEYS, "wall_mm", "planned_length_m", "color", "material", *_LINE_KEYS, *_DATE_KEYS)


@dataclass(frozen=True)
class BillLine:
    """A line of the bill: name and planned length [m]; the others are empty if not given, dates are ISO dates."""

    name: str
    planned_length: float
    system: str = ""
    zone: str = ""
    activity: str = ""
    start: str = ""
    finish: str = ""
    material: str = ""


@dataclass(frozen=True)
class PipeClass:
    """A planned class: outer radius and its tolerance (one standard deviation) [m], planned length [m], RGB in 0..1.

    wall [m] is the thickness of its wall, None where it is not given; a camera inside sees the bore.
    lines are those of the bill that have this size: two systems of one size are one class, since its pipes look alike.
    material is the one of `MATERIALS` that all its lines name, empty where they name none.
    """

    name: str
    outer_radius: float
    planned_length: float
    color: Color
    tolerance: float
    wall: float | None = None
    lines: tuple[BillLine, ...] = ()

    @property
    def material(self) -> str:
        """See above."""
        named = {line.material for line in self.lines}
        return named.pop() if len(named) == 1 and named <= set(MATERIALS) else ""

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
class PlannedPipe:
    """A pipe of a plan that has places: GUID, name, place in the plan's coordinates; its class, its line in that."""

    id: str
    name: str
    cylinder: Cylinder
    class_name: str
    line: int


@dataclass(frozen=True)
class BillOfQuantities:
    """The planned classes, in the order of the file, and the planned pipes where the plan has their places.

    notes are sentences for the user: what of the file counts, or does not, and may be a mistake.
    """

    classes: tuple[PipeClass, ...]
    pipes: tuple[PlannedPipe, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def radii(self) -> tuple[float, ...]:
        """The outer radii [m], each once."""
        return tuple(dict.fromkeys(planned.outer_radius for planned in self.classes))

    @classmethod
    def of_radii(cls, radii: Mapping[str, float]) -> BillOfQuantities:
        """Classes by their outer radii [m] alone: planned lengths are not known (nan).

        Raises InputError where there is no class or a radius is no length.
        """
        classes = [
            PipeClass(name, radius, math.nan, _NO_COLOR, max(_RELATIVE_TOLERANCE * radius, _LEAST_TOLERANCE))
            for name, radius in radii.items()
            if _positive(f"radii: class {shown(name)}", "the outer radius in metres", radius)
        ]
        if not classes:
            raise InputError("radii: no class is given: name at least one planned outer radius in metres")
        return cls(_with_colors(classes, [None] * len(classes)))


@dataclass(frozen=True)
class _Item:
    """An entry that was checked: its class with its one line, its colour where one is given, its planned pipes."""

    where: str
    planned: PipeClass
    color: Color | None
    written: WrittenSize | None
    segments: tuple[Segment, ...]


def load_boq(path: str | Path) -> BillOfQuantities:
    """Read a bill of quantities from YAML, CSV or XLSX, as docs/files.md describes it; the same checks hold for all.

    The size is outer_radius_mm, outer_diameter_mm or `size`, a standard one such as `DN50 steel` (see sizes). Lines of
    one size that differ in system, zone or activity make one class.

    Raises InputError, naming the file, the value and the remedy, for anything that is no bill of quantities.
    """
    path = Path(path)
    plan = read_plan(path)
    if len(plan.entries) > MAX_CLASSES:
        raise InputError(
            f"{path}: {len(plan.entries)} classes: plan {MAX_CLASSES} at most, or split the bill by trades"
        )
    items = [_read_item(entry, number) for number, entry in enumerate(plan.entries, 1)]
    written = [item for item in items if not item.segments]  # the others are those of bodies in one unit
    ask_about_units([item.written for item in written if item.written is not None])
    for item in written:
        ask_about_length(item.where, item.planned.name, item.planned.planned_length)
    for item in items:
        if item.planned.outer_radius < MIN_PIPE_RADIUS:
            raise InputError(
                f"{item.where}: an outer radius of {item.planned.outer_radius:g} m is that of no pipe: "
                "write millimetres"
            )
    return replace(_grouped(items), notes=plan.notes)


def _grouped(items: Sequence[_Item]) -> BillOfQuantities:
    """The bill of all items; those of one size become one class of several lines."""
    groups: list[list[_Item]] = []
    for item in items:
        group = next((group for group in groups if _look_alike(group[0], item, items)), None)
        _refuse_double(item, group or [], [other for other in groups if other is not group])
        if group is None:
            groups.append([item])
        else:
            group.append(item)
    classes = [_joined([item.planned for item in group]) for group in groups]
    for (one, first), (other, _) in combinations(zip(classes, groups, strict=True), 2):
        _refuse_near(first[0].where, one, other)
    colors = [next((item.color for item in group if item.color is not None), None) for group in groups]
    pipes = [
        PlannedPipe(one.id, one.name, Cylinder(one.start, one.end, item.planned.outer_radius), planned.name, line)
        for planned, group in zip(classes, groups, strict=True)
        for line, item in enumerate(group)
        for one in item.segments
    ]
    return BillOfQuantities(_with_colors(classes, colors), tuple(pipes))


def _look_alike(one: _Item, other: _Item, items: Sequence[_Item]) -> bool:
    """Whether two items have one size and are not told apart by their materials, which all items of the size name."""
    if not _same_size(one, other):
        return False
    named = all(item.planned.material for item in items if _same_size(item, one))
    return not named or one.planned.material == other.planned.material


def _same_size(one: _Item, other: _Item) -> bool:
    return math.isclose(one.planned.outer_radius, other.planned.outer_radius, rel_tol=1e-6)


def _refuse_double(item: _Item, group: Sequence[_Item], other_sizes: Sequence[Sequence[_Item]]) -> None:
    """Raises InputError where nothing tells an item from one of its size, or where another size has its name."""
    (new,) = item.planned.lines
    alike = [line for other in group for line in other.planned.lines if _same_place(line, new)]
    if any(line.name == new.name for line in alike) or any(
        other.planned.name == new.name for others in other_sizes for other in others
    ):
        raise InputError(
            f"{item.where}: class {shown(new.name)} is listed twice: keep one, or give the other its own name"
        )
    if alike:
        raise InputError(
            f"{item.where}: classes {shown(alike[0].name)} and {shown(new.name)} have the same outer radius "
            f"{1e3 * item.planned.outer_radius:g} mm and cannot be told apart: merge them, or give each its system, "
            f"zone or activity, or a material that can be seen ({', '.join(MATERIALS[:4])}, ...)"
        )


def _refuse_near(where: str, one: PipeClass, other: PipeClass) -> None:
    """Raises InputError where the radii of two classes are too near, and no materials tell these apart."""
    if round(abs(one.outer_radius - other.outer_radius), 9) >= LEAST_RADIUS_STEP:
        return
    if one.material and other.material and one.material != other.material:
        return
    radii = f"{1e3 * one.outer_radius:g} and {1e3 * other.outer_radius:g} mm"
    raise InputError(
        f"{where}: classes {shown(one.name)} and {shown(other.name)} have outer radii of {radii}, and a survey tells "
        f"steps of {1e3 * LEAST_RADIUS_STEP:g} mm at best: write one size for both, or give each a material that can "
        f"be seen ({', '.join(MATERIALS[:4])}, ...)"
    )


def _same_place(one: BillLine, other: BillLine) -> bool:
    return all(getattr(one, key) == getattr(other, key) for key in _LINE_KEYS)


def _joined(classes: Sequence[PipeClass]) -> PipeClass:
    """One class of classes of one size."""
    first = classes[0]
    if len(classes) == 1:
        return first
    names = list(dict.fromkeys(planned.name for planned in classes))
    name = " + ".join(names)
    return PipeClass(
        name if len(name) <= MAX_NAME else f"{names[0][: MAX_NAME - 32]} + {len(names) - 1} others",
        first.outer_radius,
        math.fsum(planned.planned_length for planned in classes),
        _NO_COLOR,
        max(planned.tolerance for planned in classes),
        first.wall if all(planned.wall == first.wall for planned in classes) else None,
        tuple(line for planned in classes for line in planned.lines),
    )


def _read_item(given: Entry, number: int) -> _Item:
    """Checks an entry, the number-th of its file."""
    where, entry = given.where, given.values
    if not isinstance(entry, dict):
        raise InputError(f"{where}: class {number} is {shown(entry)}: write name, outer_radius_mm and planned_length_m")
    if "name" not in entry:
        raise InputError(f"{where}: class {number} has no name: give each class a name")
    name = name_of(entry["name"], f"{where}: the name of class {number}")
    _refuse_unknown(where, name, entry)
    where = f"{where}: class {shown(name)}"
    radius, tolerance = _read_size(where, entry)
    if radius > MAX_PIPE_RADIUS:
        raise InputError(f"{where}: an outer radius of {radius:g} m is that of no pipe: write millimetres")
    line = _read_line(where, name, entry)
    wall = 1e-3 * _positive(where, "wall_mm", entry["wall_mm"]) if "wall_mm" in entry else None
    if wall is not None and wall >= radius:
        raise InputError(f"{where}: wall_mm is {1e3 * wall:g}, more than the radius: write the wall's thickness")
    key = next(key for key in _SIZE_KEYS if key in entry)
    return _Item(
        given.where,
        PipeClass(name, radius, line.planned_length, _NO_COLOR, tolerance, wall, (line,)),
        read_color(where, entry["color"]) if "color" in entry else None,
        None if key == "size" else WrittenSize(given.where, name, key, float(entry[key]), line.material == "insulated"),
        given.segments,
    )


def _read_line(where: str, name: str, entry: dict[str, object]) -> BillLine:
    if "planned_length_m" not in entry:
        raise InputError(f"{where} has no planned_length_m: give the metres that are planned")
    length = _positive(where, "planned_length_m", entry["planned_length_m"])
    if length > MAX_PIPE_LENGTH:
        raise InputError(f"{where}: planned_length_m is {length:g}: write metres, {MAX_PIPE_LENGTH:g} at most")
    material = read_material(where, entry["material"]) if "material" in entry else ""
    system, zone, activity = (name_of(entry[key], f"{where}: {key}") if key in entry else "" for key in _LINE_KEYS)
    start, finish = (_read_day(f"{where}: {key}", entry[key]) if key in entry else "" for key in _DATE_KEYS)
    if start and finish and finish < start:
        raise InputError(f"{where}: finish {finish} lies before start {start}: mend one of them")
    return BillLine(name, length, system, zone, activity, start, finish, material)


def _read_day(where: str, value: object) -> str:
    """An ISO date."""
    text = name_of(value, where)
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise InputError(f"{where} is {shown(text)}: write the date as YYYY-MM-DD, such as 2026-03-31") from None


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
        if isinstance(value, str) and re.fullmatch(r"\d+,\d+", value):
            raise InputError(f"{where}: {key} is {shown(value)}: write {value.replace(',', '.')}, with a decimal point")
        raise InputError(f"{where}: {key} is {shown(value)}: write a number")
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{where}: {key} is {shown(value)}: write a number above zero")
    return float(value)


def _refuse_unknown(where: str, name: str, entry: dict[object, object]) -> None:
    for key in entry:
        if key in _KEYS:
            continue
        if isinstance(key, int) and entry[key] is None:  # `{outer_radius_mm: 57,5}` is 57 and a key 5
            raise InputError(
                f"{where}: class {shown(name)}: {key} stands alone: is it behind a decimal comma? Write 57.5 for 57,5"
            )
        raise InputError(
            f"{where}: unknown key {shown(key)} in class {shown(name)}: did you mean '{nearest(key, _KEYS)}'?"
        )


def _with_colors(classes: Sequence[PipeClass], given: Sequence[Color | None]) -> tuple[PipeClass, ...]:
    """The classes with the colours that are given, the others with ones that tell them apart."""
    colors = distinct_colors([planned.outer_radius for planned in classes], given)
    return tuple(replace(planned, color=color) for planned, color in zip(classes, colors, strict=True))
