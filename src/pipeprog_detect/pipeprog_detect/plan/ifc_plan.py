# SPDX-License-Identifier: Apache-2.0
"""A plan in IFC: its straight pipes with their places, summed up to the lines of a bill of quantities.

The one module of the plan that imports IfcOpenShell, which is an extra; it does so in a child process, since damaged
files can end the process that reads them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import require_regular
from pipeprog_camera.limits import MAX_COORDINATE, MAX_IFC, MAX_NAME, MAX_PIPES
from pipeprog_camera.outside_text import shown
from pipeprog_detect.plan.entry import LEAST_RADIUS_STEP, Entry, Plan, Segment
from pipeprog_detect.plan.materials import known_material

_INSTALL = "plans in IFC need IfcOpenShell: `pip install ifcopenshell==0.9.0.post1` (or `make setup EXCHANGE=1`)"
_NESTED = 8  # mapped items within each other; exporters write one
_STEP = 1e-5  # m to which outer radii are rounded: sizes of one class differ by less in files of single precision
# Of a mesh, the principal axis is that of the pipe where it is this much longer than wide.
_SLENDER = 2.0
# m; where all outer diameters are smaller (capillary tubes have 3.4 mm) or all larger (penstocks have some metres), the
# numbers are in another unit than the file names: a DN200 of 0.2 mm, a DN15 of 21.3 m.
_THINNEST, _THICKEST = 3e-3, 10.0
_SAME_PLACE = 1e-3  # m; ends of a body and its copy are nearer, those of two pipes are a diameter apart
_NAMED = 3  # pipes that a note names; the others are counted
_END = b"END-ISO-10303-21;"


@dataclass(frozen=True)
class _Straight:
    """A planned pipe: its segment, its outer radius [m], and what it belongs to."""

    segment: Segment
    radius: float
    type_name: str
    place: tuple[str, str, str]  # system, zone, activity
    days: tuple[str, str]  # planned start and finish, ISO dates or empty
    material: str  # one that can be seen, or empty


def read_ifc_plan(path: Path) -> Plan:
    """The pipes of an IFC file as entries of a bill, one for each size and material in each system, zone and activity.

    Notes tell the pipes that no cylinder could be made of, and those that lie in one place. Raises InputError where the
    file is none or cut off, holds no straight pipe with a place, or has another unit than it names, and where
    IfcOpenShell is not installed.
    """
    require_regular(path)
    if path.stat().st_size > MAX_IFC:
        raise InputError(f"{path} is larger than {MAX_IFC >> 20} MiB: export the pipes' discipline alone")
    if find_spec("ifcopenshell") is None:
        raise InputError(f"{path}: {_INSTALL}")
    straights, left_out = _read_in_child(path)
    if _END not in path.read_bytes()[-4096:]:
        raise InputError(f"{path} cannot be read as IFC (it is cut off: {_END.decode()} is missing): export it again")
    if not straights:
        raise InputError(f"{path} holds no straight pipe (IfcPipeSegment with a round body): export pipes as solids")
    diameters = [2.0 * one.radius for one in straights]
    if max(diameters) < _THINNEST or min(diameters) > _THICKEST:
        raise InputError(
            f"{path}: its pipes are {1e3 * min(diameters):g} to {1e3 * max(diameters):g} mm across: the unit of length "
            "that the file names is not that of its numbers: export it again, with metres as metres"
        )
    notes = [*_of_left_out(left_out, len(straights)), *_of_doubled(straights)]
    return Plan(_entries(str(path), _with_sizes(straights)), tuple(f"{path}: {note}" for note in notes))


def _of_left_out(names: Sequence[str], straights: int) -> list[str]:
    """A note on the pipes without a straight round body."""
    if not names:
        return []
    return [
        f"pipes without a straight round body count in no class, {len(names)} of {straights + len(names)}: "
        f"{_listed(names)}: export them as solids"
    ]


def _of_doubled(straights: Sequence[_Straight]) -> list[str]:
    """A note on the pipes of one size that lie in one place, so that their metres count twice."""
    from scipy.spatial import cKDTree  # a tenth of a second that only plans in IFC need

    places = np.array([[*one.segment.start, *one.segment.end, one.radius] for one in straights])
    if len(places) < 2:
        return []
    tree = cKDTree(places)
    alike = tree.query(places, k=2)[0][:, 1]
    turned = tree.query(places[:, [3, 4, 5, 0, 1, 2, 6]])[0]
    distances = np.minimum(alike, turned)
    doubled = [_name(one) for one, away in zip(straights, distances, strict=True) if away < _SAME_PLACE]
    if not doubled:
        return []
    return [
        f"{len(doubled)} pipes share their places with others of their size, and the metres of each are planned: "
        f"{_listed(doubled)}: delete copies in the plan"
    ]


def _name(one: _Straight) -> str:
    return one.segment.name or one.segment.id


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(map(shown, names[:_NAMED])) + rest


def _with_sizes(straights: Sequence[_Straight]) -> list[_Straight]:
    """The pipes, those whose radii differ by what a survey does not tell with the radius that most metres of them have.

    Exporters round radii, and a class of its own for each would get no pipe, since each pipe may be of either.
    """
    metres: dict[float, float] = {}
    for one in straights:
        metres[one.radius] = metres.get(one.radius, 0.0) + float(np.linalg.norm(one.segment.end - one.segment.start))
    groups: list[list[float]] = []
    for radius in sorted(metres):
        if groups and round(radius - groups[-1][-1], 9) < LEAST_RADIUS_STEP:
            groups[-1].append(radius)
        else:
            groups.append([radius])
    size = {radius: max(group, key=lambda one: metres[one]) for group in groups for radius in group}
    return [replace(one, radius=size[one.radius]) for one in straights]


def _read_in_child(path: Path) -> tuple[list[_Straight], list[str]]:
    """The pipes of a file, and the names of those that no cylinder could be made of.

    They are read in a process of its own, which damage to the file may end.
    """
    child = subprocess.run(
        [sys.executable, "-c", f"from {__name__} import _serve; _serve()", str(path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
    )
    try:
        answer = json.loads(child.stdout.splitlines()[-1])
        problem, rows, left_out = answer["problem"], answer["pipes"], answer["left_out"]
    except (IndexError, KeyError, TypeError, ValueError):
        problem = f"cannot be read as IFC (its reader ended with code {child.returncode}): export it again"
        rows, left_out = [], []
    if problem:
        raise InputError(f"{path} {problem}")
    straights = [
        _Straight(
            Segment(identity, name, np.array(start), np.array(end)), radius, kind, tuple(place), tuple(days), look
        )
        for identity, name, start, end, radius, kind, place, days, look in rows
    ]
    return straights, left_out


def _serve() -> None:
    """The child: writes what is wrong, or the pipes and the names of those left out, as a line of JSON."""
    import ifcopenshell

    problem = ""
    pipes: list[list[Any]] = []
    left_out: list[str] = []
    try:
        straights, left_out = _straights(ifcopenshell.open(sys.argv[1]))
        for one in straights:
            ends = one.segment.start.tolist(), one.segment.end.tolist()
            own = one.radius, one.type_name, one.place, one.days, one.material
            pipes.append([one.segment.id, one.segment.name, *ends, *own])
    except MemoryError:
        problem = "does not fit into memory: export the pipes' discipline alone"
    except InputError as error:
        problem = f"cannot be used: {error}"
    # IfcOpenShell raises exceptions of any type for files that break the schema.
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        problem = f"cannot be read as IFC ({reason}): export it again as IFC4"
    answer = {"problem": problem, "pipes": [] if problem else pipes, "left_out": left_out}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")


def _entries(path: str, straights: Sequence[_Straight]) -> list[Entry]:
    # A class is told by its material where all of its size have one.
    open_sizes = {one.radius for one in straights if not one.material}
    straights = [replace(one, material="") if one.radius in open_sizes else one for one in straights]
    groups: dict[tuple[float, str, tuple[str, str, str]], list[_Straight]] = {}
    kinds: dict[str, set[tuple[float, str]]] = {}
    for one in straights:
        groups.setdefault((one.radius, one.material, one.place), []).append(one)
        kinds.setdefault(one.type_name, set()).add((one.radius, one.material))
    entries = []
    for (radius, material, place), group in groups.items():
        values: dict[str, object] = {
            "name": _group_name(group, kinds),
            "outer_radius_mm": round(1e3 * radius, 6),
            "planned_length_m": round(sum(float(np.linalg.norm(o.segment.end - o.segment.start)) for o in group), 6),
        }
        starts, finishes = ([day for day in days if day] for days in zip(*(one.days for one in group), strict=True))
        texts = dict(zip(("system", "zone", "activity"), place, strict=True))
        texts |= {"start": min(starts, default=""), "finish": max(finishes, default=""), "material": material}
        values |= {key: text for key, text in texts.items() if text}
        entries.append(Entry(path, values, tuple(one.segment for one in group)))
    return entries


def _group_name(group: Sequence[_Straight], kinds: dict[str, set[tuple[float, str]]]) -> str:
    """Names of the pipes' types; with size and material where a type has several of them, or none has a name."""
    names = sorted({one.type_name for one in group if one.type_name})
    words = f"{2e3 * group[0].radius:g} mm", group[0].material
    if not names:
        return " ".join(words).strip()
    parts = []
    for name in names:
        differ = [len(set(values)) > 1 for values in zip(*kinds[name], strict=True)]
        parts += [" ".join([name, *(word for word, differs in zip(words, differ, strict=True) if word and differs)])]
    text = " + ".join(parts)
    return text if len(text) <= MAX_NAME // 2 else " ".join([names[0][: MAX_NAME // 4], *words]).strip()


def _straights(model: Any) -> tuple[list[_Straight], list[str]]:
    """The straight pipes of a model, and the names of its other ones."""
    from ifcopenshell.util.unit import calculate_unit_scale

    scale = float(calculate_unit_scale(model))  # metres in a unit of the file
    elements = model.by_type("IfcFlowSegment" if model.schema == "IFC2X3" else "IfcPipeSegment")
    if len(elements) > MAX_PIPES:
        raise InputError(f"{len(elements)} pipes: plan {MAX_PIPES} at most, or export it storey by storey")
    found, left_out = [], []
    for element in elements:
        start, end, radius = _place(element, scale) or (np.zeros(3), np.zeros(3), 0.0)
        if not (np.abs([*start, *end, radius]) <= MAX_COORDINATE).all():
            raise InputError(f"pipe {element.GlobalId} lies beyond all coordinates: export the plan again")
        name = _text(element.Name)
        if np.linalg.norm(end - start) > 0.0 < radius:
            rounded = round(round(radius / _STEP) * _STEP, 9)
            own = _type_name(element), _belongs_to(element), _days(element), _material(element)
            found.append(_Straight(Segment(str(element.GlobalId), name, start, end), rounded, *own))
        else:
            left_out.append(name or str(element.GlobalId))
    return found, left_out


def _place(element: Any, scale: float) -> tuple[FloatArray, FloatArray, float] | None:
    """Ends of the axis and outer radius [m] of a pipe, None where it is not a straight one."""
    from ifcopenshell.util.placement import get_local_placement

    if element.Representation is None:
        return None
    bodies = [one for one in element.Representation.Representations if one.RepresentationIdentifier in ("Body", None)]
    world = np.asarray(get_local_placement(element.ObjectPlacement), float)
    for representation in bodies:
        for item, item_to_object in _items(representation, np.eye(4), 0):
            ends = _axis(item)
            if ends is not None:
                points, radius = ends
                placed = world @ item_to_object
                moved = points @ placed[:3, :3].T + placed[:3, 3]
                grown = float(np.linalg.norm(placed[:3, 0]))
                return scale * moved[0], scale * moved[1], scale * radius * grown
    return _from_mesh(element) if bodies else None


def _items(representation: Any, to_object: FloatArray, depth: int) -> Iterator[tuple[Any, FloatArray]]:
    """The solids of a representation, mapped ones with their transform."""
    from ifcopenshell.util.placement import get_mappeditem_transformation

    for item in representation.Items:
        if item.is_a("IfcMappedItem"):
            if depth < _NESTED:
                matrix = to_object @ np.asarray(get_mappeditem_transformation(item), float)
                yield from _items(item.MappingSource.MappedRepresentation, matrix, depth + 1)
        else:
            yield item, to_object


def _axis(item: Any) -> tuple[FloatArray, float] | None:
    """Ends of the axis (2, 3) and outer radius of a solid in its own units; None where it is no straight round one."""
    from ifcopenshell.util.placement import get_axis2placement

    if item.is_a("IfcExtrudedAreaSolid") and item.SweptArea.is_a("IfcCircleProfileDef"):
        centre = np.zeros(3)
        position = item.SweptArea.Position
        if position is not None:
            centre[:2] = position.Location.Coordinates[:2]
        direction = np.asarray(item.ExtrudedDirection.DirectionRatios, float)
        way = item.Depth * direction / np.linalg.norm(direction)
        matrix = np.eye(4) if item.Position is None else np.asarray(get_axis2placement(item.Position), float)
        points = np.array([centre, centre + way]) @ matrix[:3, :3].T + matrix[:3, 3]
        return points, float(item.SweptArea.Radius)
    if item.is_a("IfcSweptDiskSolid") and item.Directrix.is_a("IfcPolyline") and len(item.Directrix.Points) == 2:
        return np.array([point.Coordinates for point in item.Directrix.Points], float), float(item.Radius)
    return None


def _from_mesh(element: Any) -> tuple[FloatArray, FloatArray, float] | None:
    """A cylinder through the vertices of a body of another kind [m]; None where it is not a slender one."""
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    try:
        shape = ifcopenshell.geom.create_shape(settings, element)
    except RuntimeError:
        return None
    vertices = np.unique(np.round(np.asarray(shape.geometry.verts, float).reshape(-1, 3), 6), axis=0)
    if len(vertices) < 6:
        return None
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    axis = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2][0]
    along = (vertices - centre) @ axis
    across = np.linalg.norm(vertices - centre - along[:, None] * axis, axis=1)
    if np.ptp(along) < _SLENDER * 2.0 * across.max():
        return None
    return centre + along.min() * axis, centre + along.max() * axis, float(across.max())


def _belongs_to(element: Any) -> tuple[str, str, str]:
    """System, zone (the storey or space that contains it) and activity, empty where the plan does not tell."""
    from ifcopenshell.util.element import get_container

    groups = [rel.RelatingGroup for rel in element.HasAssignments if rel.is_a("IfcRelAssignsToGroup")]
    systems = sorted(_text(group.Name) for group in groups if group.is_a("IfcSystem") and not group.is_a("IfcZone"))
    container = get_container(element)
    zone = "" if container is None else _text(container.Name)
    activities = sorted(_text(getattr(task, "Identification", None) or task.Name) for task in _tasks(element))
    return " + ".join(systems)[:MAX_NAME], zone, activities[0] if activities else ""


def _days(element: Any) -> tuple[str, str]:
    times = [task.TaskTime for task in _tasks(element) if getattr(task, "TaskTime", None) is not None]
    starts = [str(time.ScheduleStart)[:10] for time in times if time.ScheduleStart]
    finishes = [str(time.ScheduleFinish)[:10] for time in times if time.ScheduleFinish]
    return min(starts, default=""), max(finishes, default="")


def _tasks(element: Any) -> list[Any]:
    relations = [
        *(rel for rel in element.HasAssignments if rel.is_a("IfcRelAssignsToProcess")),
        *getattr(element, "ReferencedBy", ()),
    ]
    processes = [rel.RelatingProcess for rel in relations if rel.is_a("IfcRelAssignsToProcess")]
    outputs = [task for rel in relations if rel.is_a("IfcRelAssignsToProduct") for task in rel.RelatedObjects]
    return [task for task in (*processes, *outputs) if task.is_a("IfcTask")]


def _type_name(element: Any) -> str:
    from ifcopenshell.util.element import get_type

    kind = get_type(element)
    return _text(kind.Name if kind is not None and kind.Name else element.ObjectType)


def _material(element: Any) -> str:
    """The material of a pipe or its type that keyframes can tell; empty where it has none, or several."""
    from ifcopenshell.util.element import get_materials

    found = {known_material(_text(material.Name)) for material in get_materials(element)}
    return found.pop() if len(found) == 1 else ""


def _text(value: Any) -> str:
    """A name of the file on one line; empty for none."""
    return " ".join(str(value or "").split())[: MAX_NAME // 2]
