# SPDX-License-Identifier: Apache-2.0
"""IFC4: each pipe as IfcPipeSegment with its type, ports, quantities and what was measured, runs as systems.

The one module of exports that imports IfcOpenShell, which is an extra. Straight pipes are extruded circles, which every
viewer shows. Only what was measured is written: no walls, materials or pressures, and no fittings.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.export.guids import ifc_guid
from pipeprog_bringup.export.survey import NO_TIME, Survey, SurveyPipe, along_axis
from pipeprog_bringup.export.tables import positive
from pipeprog_bringup.results.results_reader import UNPLANNED, Color
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError

_INSTALL = "IFC needs IfcOpenShell: `pip install ifcopenshell==0.9.0.post1` (or `make setup EXCHANGE=1`)"


def write_ifc(survey: Survey, path: Path) -> None:
    """Writes the pipes as IFC4; raises InputError where IfcOpenShell is not installed."""
    try:
        import ifcopenshell  # noqa: F401
    except ImportError:
        raise InputError(_INSTALL) from None
    model = _Model(survey)
    for pipe in survey.pipes:
        model.add(pipe)
    model.add_runs()
    header = model.file.header.file_name
    header.name, header.time_stamp = "survey.ifc", (survey.finished or NO_TIME)[:19]
    _set_order(model.file)
    _set_guids(model.file)
    path.write_text(model.file.to_string(), encoding="utf-8")


class _Model:
    """The file while it is written; `segments` by the ids of their pipes."""

    def __init__(self, survey: Survey) -> None:
        from ifcopenshell.api import aggregate, context, georeference, project, root, unit

        self._survey = survey
        self.file = project.create_file(version="IFC4")
        self.segments: dict[str, Any] = {}
        self._types: dict[str, Any] = {}
        self._styles: dict[str, Any] = {}
        whole = root.create_entity(self.file, "IfcProject", name=survey.recording or "pipeprog")
        unit.assign_unit(self.file, length={"is_metric": True, "raw": "METERS"})
        model = context.add_context(self.file, "Model")
        self._body = context.add_context(
            self.file, "Model", context_identifier="Body", target_view="MODEL_VIEW", parent=model
        )
        above = whole
        for kind in ("IfcSite", "IfcBuilding", "IfcBuildingStorey"):
            part = root.create_entity(self.file, kind, name="Survey")
            aggregate.assign_object(self.file, products=[part], relating_object=above)
            above = part
        self._storey = above
        if survey.site.origin.any():
            georeference.add_georeferencing(self.file, name=survey.site.crs or "site")
            names = ("Eastings", "Northings", "OrthogonalHeight")
            offsets = dict(zip(names, map(float, survey.site.origin), strict=True))
            georeference.edit_georeferencing(self.file, coordinate_operation=offsets)

    def add(self, pipe: SurveyPipe) -> None:
        """A segment in its place, with its ports, quantities and property set."""
        from ifcopenshell.api import geometry, profile, root, spatial, type

        segment = root.create_entity(self.file, "IfcPipeSegment", name=pipe.id)
        if pipe.class_name:
            type.assign_type(self.file, related_objects=[segment], relating_type=self._type_of(pipe.class_name))
        else:
            segment.PredefinedType = "RIGIDSEGMENT"
        placement = along_axis(pipe.cylinder, self._survey.site.origin)
        geometry.edit_object_placement(self.file, product=segment, matrix=placement)
        circle = profile.add_parameterized_profile(self.file, ifc_class="IfcCircleProfileDef")
        profile.edit_profile(
            self.file, circle, {"ProfileName": pipe.class_name or "unplanned", "Radius": float(pipe.cylinder.radius)}
        )
        body = geometry.add_profile_representation(
            self.file, context=self._body, profile=circle, depth=float(pipe.cylinder.length)
        )
        geometry.assign_representation(self.file, product=segment, representation=body)
        self._paint(body, pipe.class_name)
        spatial.assign_container(self.file, products=[segment], relating_structure=self._storey)
        self._measure(segment, pipe)
        for number, at in enumerate((0.0, pipe.cylinder.length), 1):
            self._add_port(segment, f"{pipe.id}/{number}", placement, at)
        self.segments[pipe.id] = segment

    def add_runs(self) -> None:
        """The runs, as systems of their segments."""
        from ifcopenshell.api import system

        for name in dict.fromkeys(pipe.run for pipe in self._survey.pipes if pipe.run):
            products = [self.segments[pipe.id] for pipe in self._survey.pipes if pipe.run == name]
            run = system.add_system(self.file, ifc_class="IfcDistributionSystem")
            system.edit_system(self.file, system=run, attributes={"Name": name})
            system.assign_system(self.file, products=products, system=run)

    def _type_of(self, class_name: str) -> Any:
        from ifcopenshell.api import pset, root

        if class_name not in self._types:
            kind = root.create_entity(self.file, "IfcPipeSegmentType", predefined_type="RIGIDSEGMENT", name=class_name)
            nominal = next(row["outer_radius"] for row in self._survey.results.classes if row["class"] == class_name)
            common = pset.add_pset(self.file, product=kind, name="Pset_PipeSegmentTypeCommon")
            pset.edit_pset(self.file, pset=common, properties={"OuterDiameter": 2.0 * float(nominal)})
            self._types[class_name] = kind
        return self._types[class_name]

    def _paint(self, body: Any, class_name: str) -> None:
        from ifcopenshell.api import style

        if class_name not in self._styles:
            color: Color = self._survey.results.colors.get(class_name, UNPLANNED)
            parts = dict(zip(("Red", "Green", "Blue"), map(float, color), strict=True))
            paint = style.add_style(self.file, name=class_name or "unplanned")
            attributes = {"SurfaceColour": {"Name": None, **parts}, "Transparency": 0.0}
            style.add_surface_style(self.file, style=paint, ifc_class="IfcSurfaceStyleShading", attributes=attributes)
            self._styles[class_name] = paint
        style.assign_representation_styles(
            self.file,
            shape_representation=body,
            styles=[self._styles[class_name]],
            should_use_presentation_style_assignment=False,
        )

    def _measure(self, segment: Any, pipe: SurveyPipe) -> None:
        """Standard quantities, and the set of what pipeprog measured."""
        from ifcopenshell.api import pset

        quantities = pset.add_qto(self.file, product=segment, name="Qto_PipeSegmentBaseQuantities")
        pset.edit_qto(self.file, qto=quantities, properties={"Length": float(pipe.cylinder.length)})
        row, survey = pipe.row, self._survey
        properties = {
            "Pipe": pipe.id,
            "Class": pipe.class_name,
            "ClassProbability": positive(row.get("class_probability")),
            "OuterRadius": float(pipe.cylinder.radius),
            "OuterRadiusStandardDeviation": positive(row.get("radius_sigma")),
            "LengthStandardDeviation": positive(row.get("length_sigma")),
            "VisibleArcDegrees": positive(row.get("visible_arc_deg")),
            "Run": pipe.run,
            "Recording": survey.recording,
            "SurveyFinished": survey.finished,
            "ScaleSource": str(survey.results.scale.get("source") or ""),
            "ScaleStandardDeviation": positive(survey.results.scale.get("sigma")),
        }
        own = pset.add_pset(self.file, product=segment, name="Pipeprog_Measurement")
        given = {name: value for name, value in properties.items() if value not in ("", None)}
        pset.edit_pset(self.file, pset=own, properties=given)

    def _add_port(self, segment: Any, name: str, placement: FloatArray, at: float) -> None:
        """A port on the axis, z out of the pipe."""
        from ifcopenshell.api import geometry, system

        port = system.add_port(self.file, element=segment)
        port.Name, port.PredefinedType = name, "PIPE"
        outward = np.diag([1.0, 1.0, 1.0, 1.0]) if at > 0.0 else np.diag([1.0, -1.0, -1.0, 1.0])
        outward[2, 3] = at
        geometry.edit_object_placement(self.file, product=port, matrix=placement @ outward)


def _set_order(file: Any) -> None:
    """Sets of entities in the order in which these were made; IfcOpenShell keeps them in that of their addresses."""
    for entity in (*file.by_type("IfcRelationship"), *file.by_type("IfcUnitAssignment")):
        for index, value in enumerate(entity):
            if isinstance(value, tuple):
                entity[index] = tuple(sorted(value, key=lambda one: int(one.id())))


def _set_guids(file: Any) -> None:
    """GUIDs of names: of what has one by its name, of the others by their order, which the results fix."""
    seen: Counter[str] = Counter()
    for entity in file.by_type("IfcRoot"):
        key = f"{entity.is_a()}/{entity.Name or ''}"
        seen[key] += 1
        entity.GlobalId = ifc_guid(f"{key}/{seen[key]}")
