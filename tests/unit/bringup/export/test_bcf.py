# SPDX-License-Identifier: Apache-2.0
"""BCF: topics of what needs a person, as the files of its schema, with the GUIDs of the IFC file and of the plan."""

from __future__ import annotations

import zipfile
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from pipeprog_bringup.export.formats import export
from pipeprog_bringup.results.plan_file import write_plan
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.types import Cylinder
from tests.unit.bringup.export.conftest import BOTH, PIPES

ELSEWHERE = Cylinder(np.array([5.0, 0, 0]), np.array([7.0, 0, 0]), 0.02415)


@pytest.fixture
def planned(folder: Path) -> Path:
    """The results with a plan: one pipe in its place, one moved, one missing."""
    moved = PIPES[2].cylinder.shifted(np.array([0, 0.04, 0]))
    pipes = [
        PlannedPipe("guid-1", "riser", PIPES[0].cylinder, "=DN65", 0),
        PlannedPipe("guid-2", "sprinkler 7", moved, BOTH, 1),
        PlannedPipe("guid-3", "heating <3>", ELSEWHERE, BOTH, 0),
    ]
    write_plan(folder / "plan.json", pipes)
    return folder


def test_topics_are_what_needs_a_person(planned: Path, tmp_path: Path) -> None:
    (path,) = export(planned, ["bcf"], tmp_path / "out")
    topics = {}
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        assert names[0] == "bcf.version"
        for name in names:
            if name.endswith("markup.bcf"):
                markup = Xml.fromstring(archive.read(name))
                view = Xml.fromstring(archive.read(name.replace("markup.bcf", "viewpoint.bcfv")))
                topics[markup.findtext("Topic/Title")] = markup, view
    assert set(topics) == {
        "p02: not planned",
        "sprinkler 7: 40 mm from its planned place",
        "heating <3>: not found",
    }
    _, view = topics["heating <3>: not found"]
    component = view.find("Components/Selection/Component")
    assert component is not None
    assert component.get("IfcGuid") == "guid-3"
    eye, way = (
        np.array([float(view.findtext(f"PerspectiveCamera/{name}/{axis}") or "nan") for axis in "XYZ"])
        for name in ("CameraViewPoint", "CameraDirection")
    )
    np.testing.assert_allclose(eye + (2.0 + ELSEWHERE.length) * way, ELSEWHERE.middle, atol=1e-5)


def test_the_same_results_give_the_same_bytes(planned: Path, tmp_path: Path) -> None:
    (once,), (again,) = (export(planned, ["bcf"], tmp_path / name) for name in ("once", "again"))
    assert once.read_bytes() == again.read_bytes()


@pytest.mark.skipif(find_spec("ifcopenshell") is None, reason="IfcOpenShell is not installed: make setup EXCHANGE=1")
def test_a_topic_selects_the_pipe_of_the_ifc_file(planned: Path, tmp_path: Path) -> None:
    import ifcopenshell

    issues, model = export(planned, ["bcf", "ifc"], tmp_path / "out")
    file = ifcopenshell.open(str(model))
    (segment,) = (one for one in file.by_type("IfcPipeSegment") if one.Name == "p02")
    with zipfile.ZipFile(issues) as archive:
        assert any(segment.GlobalId.encode() in archive.read(name) for name in archive.namelist())
