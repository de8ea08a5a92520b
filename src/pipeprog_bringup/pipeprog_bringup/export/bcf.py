# SPDX-License-Identifier: Apache-2.0
"""BCF 2.1: what needs a person, as topics with a viewpoint; the pipe is selected where the IFC file or the plan has it.

The format is a zip of small XML files, so it is written here. Coordinates are those of the IFC file.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from pipeprog_bringup.export.guids import pipe_guid, uuid_of
from pipeprog_bringup.export.survey import NO_TIME, Survey
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.installed_where_planned import PlannedState
from pipeprog_detect.types import Cylinder

_AUTHOR = "pipeprog"
_DISTANCE = 2.0  # m from the camera to a pipe's middle, and as much as the pipe is long
_FIELD_OF_VIEW = 60.0  # degrees
_DAY = (2000, 1, 1, 0, 0, 0)  # of the files in the archive: the same results, the same bytes


@dataclass(frozen=True)
class _Topic:
    """Something that needs a person: a key that tells it from all others, title, description, place, object's GUID."""

    key: str
    title: str
    description: str
    cylinder: Cylinder
    guid: str


def write_bcf(survey: Survey, path: Path) -> None:
    """Writes a topic for each pipe without a class and each planned pipe that was moved or not found."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        version = Xml.Element("Version", VersionId="2.1")
        Xml.SubElement(version, "DetailedVersion").text = "2.1"
        _add(archive, "bcf.version", version)
        for topic in _topics(survey):
            folder = str(uuid_of(f"topic/{topic.key}"))
            _add(archive, f"{folder}/markup.bcf", _markup(topic, folder, survey.finished or NO_TIME))
            _add(archive, f"{folder}/viewpoint.bcfv", _viewpoint(topic, survey.site.origin))


def _topics(survey: Survey) -> Iterator[_Topic]:
    for pipe in survey.pipes:
        if pipe.class_name:
            continue
        size = f"outer radius {1e3 * pipe.cylinder.radius:.1f} mm, length {pipe.cylinder.length:.2f} m"
        if pipe.row.get("ambiguous"):
            title, text = f"{pipe.id}: which class?", f"Two planned classes explain its size ({size})."
        else:
            title, text = f"{pipe.id}: not planned", f"No planned class has its size ({size})."
        yield _Topic(f"pipe/{pipe.id}", title, text, pipe.cylinder, pipe_guid(pipe.id))
    for state in survey.planned:
        if state.state != "installed":
            yield _planned_topic(state)


def _planned_topic(state: PlannedState) -> _Topic:
    planned = state.planned
    name = planned.name or planned.id
    if state.found:
        found = ", ".join(state.found)
        title = f"{name}: {1e3 * max(state.across, abs(state.along)):.0f} mm from its planned place"
        text = (
            f"Found as {found}: {1e3 * state.across:.0f} mm off the planned axis, "
            f"shifted by {1e3 * state.along:.0f} mm along it."
        )
    else:
        title = f"{name}: not found"
        text = "No pipe of its size lies near its planned place: it is hidden, was not filmed, or is not installed."
    return _Topic(f"planned/{planned.id}", title, f"{planned.class_name}. {text}", planned.cylinder, planned.id)


def _markup(topic: _Topic, folder: str, created: str) -> Xml.Element:
    root = Xml.Element("Markup")
    entry = Xml.SubElement(root, "Topic", Guid=folder, TopicType="Issue", TopicStatus="Open")
    for name, text in (
        ("Title", topic.title),
        ("CreationDate", created),
        ("CreationAuthor", _AUTHOR),
        ("Description", topic.description),
    ):
        Xml.SubElement(entry, name).text = text
    view = Xml.SubElement(root, "Viewpoints", Guid=str(uuid_of(f"viewpoint/{topic.key}")))
    Xml.SubElement(view, "Viewpoint").text = "viewpoint.bcfv"
    return root


def _viewpoint(topic: _Topic, origin: FloatArray) -> Xml.Element:
    """A camera across the pipe, level but where the pipe itself points at it."""
    root = Xml.Element("VisualizationInfo", Guid=str(uuid_of(f"viewpoint/{topic.key}")))
    components = Xml.SubElement(root, "Components")
    Xml.SubElement(Xml.SubElement(components, "Selection"), "Component", IfcGuid=topic.guid)
    Xml.SubElement(components, "Visibility", DefaultVisibility="true")
    axis = topic.cylinder.axis
    towards = np.cross(axis, [0.0, 0.0, 1.0])
    towards = towards / np.linalg.norm(towards) if np.linalg.norm(towards) > 1e-6 else np.array([0.0, 1.0, 0.0])
    eye = topic.cylinder.middle - origin - (_DISTANCE + topic.cylinder.length) * towards
    camera = Xml.SubElement(root, "PerspectiveCamera")
    up = np.array([0.0, 0.0, 1.0])
    for name, vector in (("CameraViewPoint", eye), ("CameraDirection", towards), ("CameraUpVector", up)):
        entry = Xml.SubElement(camera, name)
        for axis_name, value in zip("XYZ", vector, strict=True):
            Xml.SubElement(entry, axis_name).text = f"{float(value):.6f}"
    Xml.SubElement(camera, "FieldOfView").text = f"{_FIELD_OF_VIEW:g}"
    return root


def _add(archive: zipfile.ZipFile, name: str, root: Xml.Element) -> None:
    Xml.indent(root)
    content = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    archive.writestr(zipfile.ZipInfo(name, _DAY), content, zipfile.ZIP_DEFLATED)
