# SPDX-License-Identifier: Apache-2.0
"""Generated plans: pipes as tests want them, and their IFC file as a planner's program writes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_detect.types import Cylinder


def write_plan_ifc(
    path: Path,
    pipes: Sequence[tuple[str, str, Cylinder]],
    millimetres: bool = True,
    mapped: bool = False,
    systems: dict[str, str] | None = None,
    materials: dict[str, str] | None = None,
) -> None:
    """Pipes by name, type and place; in the file's unit, placed relative to a storey that is turned and moved."""
    from ifcopenshell.api import (
        aggregate,
        context,
        geometry,
        material,
        profile,
        project,
        root,
        spatial,
        system,
        type,
        unit,
    )

    file = project.create_file(version="IFC4")
    whole = root.create_entity(file, "IfcProject", name="Plan")
    length = {"is_metric": True, "raw": "MILLIMETERS" if millimetres else "METERS"}
    unit.assign_unit(file, length=length)
    scale = 1e-3 if millimetres else 1.0
    body = context.add_context(
        file, "Model", context_identifier="Body", target_view="MODEL_VIEW", parent=context.add_context(file, "Model")
    )
    storey = root.create_entity(file, "IfcBuildingStorey", name="Level 1")
    aggregate.assign_object(file, products=[storey], relating_object=whole)
    turn = np.array([[0.0, -1, 0, 12.5], [1, 0, 0, -3.25], [0, 0, 1, 4.0], [0, 0, 0, 1]])
    geometry.edit_object_placement(file, product=storey, matrix=turn)
    types: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for name, kind, cylinder in pipes:
        if kind not in types:
            types[kind] = root.create_entity(file, "IfcPipeSegmentType", predefined_type="RIGIDSEGMENT", name=kind)
        segment = root.create_entity(file, "IfcPipeSegment", name=name)
        type.assign_type(file, related_objects=[segment], relating_type=types[kind])
        geometry.edit_object_placement(file, product=segment, matrix=_along(cylinder))
        circle = profile.add_parameterized_profile(file, ifc_class="IfcCircleHollowProfileDef")
        sizes = {"Radius": cylinder.radius / scale, "WallThickness": 0.002 / scale}
        profile.edit_profile(file, circle, {"ProfileName": kind, **sizes})
        shape = geometry.add_profile_representation(file, context=body, profile=circle, depth=cylinder.length)
        if mapped:
            shape = geometry.map_representation(file, representation=shape)
        geometry.assign_representation(file, product=segment, representation=shape)
        spatial.assign_container(file, products=[segment], relating_structure=storey)
        if systems:
            if systems[name] not in groups:
                groups[systems[name]] = system.add_system(file, ifc_class="IfcDistributionSystem")
                groups[systems[name]].Name = systems[name]
            system.assign_system(file, products=[segment], system=groups[systems[name]])
        if materials:
            made_of = material.add_material(file, name=materials[name])
            material.assign_material(file, products=[segment], material=made_of)
    file.write(str(path))


def _along(cylinder: Cylinder) -> np.ndarray:
    matrix = np.eye(4)
    x = np.cross(cylinder.axis, [0.31, 0.2, -0.7])
    matrix[:3, 0] = x / np.linalg.norm(x)
    matrix[:3, 1] = np.cross(cylinder.axis, matrix[:3, 0])
    matrix[:3, 2], matrix[:3, 3] = cylinder.axis, cylinder.start
    return matrix
