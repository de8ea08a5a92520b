# SPDX-License-Identifier: Apache-2.0
"""Plans in IFC: the same bill as from YAML, and the planned pipes in their places."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.types import Cylinder
from tests.unit.detect.plan.ifc_site import write_plan_ifc

needs_ifc = pytest.mark.skipif(
    find_spec("ifcopenshell") is None, reason="IfcOpenShell is not installed: make setup EXCHANGE=1"
)
PIPES = [
    ("a", "DN100", Cylinder(np.array([12.0, -3.0, 4.5]), np.array([14.5, -3.0, 4.5]), 0.05715)),
    ("b", "DN100", Cylinder(np.array([12.0, -2.0, 4.5]), np.array([12.0, -2.0, 7.0]), 0.05715)),
    ("c", "DN50", Cylinder(np.array([11.0, -2.0, 5.0]), np.array([13.0, -1.0, 5.2]), 0.03015)),
]
YAML = f"""
classes:
  - {{name: DN100, outer_radius_mm: 57.15, planned_length_m: 5, system: heating, zone: Level 1}}
  - {{name: DN50, outer_diameter_mm: 60.3, planned_length_m: {PIPES[2][2].length:.6f}, system: water, zone: Level 1}}
"""
SYSTEMS = {"a": "heating", "b": "heating", "c": "water"}


@needs_ifc
@pytest.mark.parametrize("millimetres", [True, False])
@pytest.mark.parametrize("mapped", [True, False])
def test_a_plan_in_ifc_gives_the_same_bill_as_yaml(tmp_path: Path, millimetres: bool, mapped: bool) -> None:
    write_plan_ifc(tmp_path / "plan.ifc", PIPES, millimetres, mapped, SYSTEMS)
    (tmp_path / "boq.yaml").write_text(YAML)
    plan = load_boq(tmp_path / "plan.ifc")
    assert plan.classes == load_boq(tmp_path / "boq.yaml").classes
    assert [(pipe.name, pipe.class_name) for pipe in plan.pipes] == [("a", "DN100"), ("b", "DN100"), ("c", "DN50")]
    for pipe, (_, _, place) in zip(plan.pipes, PIPES, strict=True):
        np.testing.assert_allclose([pipe.cylinder.start, pipe.cylinder.end], [place.start, place.end], atol=1e-6)
    assert len({pipe.id for pipe in plan.pipes}) == 3


@needs_ifc
def test_a_type_of_several_sizes_and_two_systems_of_one_size(tmp_path: Path) -> None:
    pipes = [(name, "Pipe", place) for name, _, place in PIPES]
    write_plan_ifc(tmp_path / "plan.ifc", pipes, systems={"a": "heating", "b": "water", "c": "water"})
    plan = load_boq(tmp_path / "plan.ifc")
    assert [(one.name, len(one.lines)) for one in plan.classes] == [("Pipe 114.3 mm", 2), ("Pipe 60.3 mm", 1)]
    assert [(pipe.name, pipe.line) for pipe in plan.pipes] == [("a", 0), ("b", 1), ("c", 0)]


@needs_ifc
def test_pipes_of_one_size_are_told_apart_by_their_materials(tmp_path: Path) -> None:
    pipes = [(name, "Pipe", place) for name, _, place in PIPES]
    write_plan_ifc(tmp_path / "plan.ifc", pipes, materials={"a": "Kupfer", "b": "steel, galvanised", "c": "Copper"})
    unknown = load_boq(tmp_path / "plan.ifc")
    assert [one.material for one in unknown.classes] == ["", "copper"], "not all of 114.3 mm have a known one"
    write_plan_ifc(tmp_path / "plan.ifc", pipes, materials={"a": "Kupfer", "b": "Grey PVC", "c": "Copper"})
    plan = load_boq(tmp_path / "plan.ifc")
    assert [(one.name, one.material) for one in plan.classes] == [
        ("Pipe 114.3 mm copper", "copper"),
        ("Pipe 114.3 mm PVC grey", "PVC grey"),
        ("Pipe 60.3 mm copper", "copper"),
    ]


@needs_ifc
@pytest.mark.parametrize(
    "text",
    [
        "",
        "ISO-10303-21;\nHEADER;\n",
        "classes: []",
        "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n",
    ],
)
def test_what_is_no_plan_is_told_so(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.ifc"
    path.write_text(text)
    with pytest.raises(InputError, match=r"plan\.ifc (cannot be read as IFC|holds no straight pipe)"):
        load_boq(path)


@needs_ifc
def test_pipes_that_are_left_out_are_told(tmp_path: Path) -> None:
    import ifcopenshell

    path = tmp_path / "plan.ifc"
    write_plan_ifc(path, PIPES)
    model = ifcopenshell.open(str(path))
    model.by_type("IfcPipeSegment")[1].Representation = None
    model.write(str(path))
    plan = load_boq(path)
    assert [one.planned_length for one in plan.classes] == pytest.approx([2.5, PIPES[2][2].length])
    assert plan.notes == (
        f"{path}: pipes without a straight round body count in no class, 1 of 3: 'b': export them as solids",
    )


@needs_ifc
@pytest.mark.parametrize("is_turned", [False, True])
def test_two_pipes_in_one_place_are_told(tmp_path: Path, is_turned: bool) -> None:
    place = PIPES[0][2]
    copy = Cylinder(place.end, place.start, place.radius) if is_turned else place
    write_plan_ifc(tmp_path / "plan.ifc", [*PIPES, ("a2", "DN100", copy)])
    plan = load_boq(tmp_path / "plan.ifc")
    assert plan.classes[0].planned_length == pytest.approx(7.5)
    (note,) = plan.notes
    assert "2 pipes share their places with others of their size" in note
    assert "'a', 'a2': delete copies in the plan" in note


@needs_ifc
def test_sizes_that_differ_by_rounding_are_one(tmp_path: Path) -> None:
    rounded = [
        Cylinder(one.start, one.end, radius) for (_, _, one), radius in zip(PIPES, (57.5, 57.52, 57.8), strict=True)
    ]
    pipes = [
        (name, "DN100", replace(one, radius=1e-3 * one.radius))
        for (name, _, _), one in zip(PIPES, rounded, strict=True)
    ]
    write_plan_ifc(tmp_path / "plan.ifc", pipes)
    plan = load_boq(tmp_path / "plan.ifc")
    assert [(one.name, 1e3 * one.outer_radius, one.planned_length) for one in plan.classes] == [
        ("DN100", pytest.approx(57.5), pytest.approx(5.0 + PIPES[2][2].length))
    ]


@needs_ifc
@pytest.mark.parametrize(
    ("factor", "told"),
    [(1e-3, "its pipes are 0.06 to 0.12 mm across"), (1e3, "its pipes are 60300 to 114300 mm across")],
)
def test_numbers_in_another_unit_than_the_file_names_are_told(tmp_path: Path, factor: float, told: str) -> None:
    pipes = [(name, kind, Cylinder(factor * p.start, factor * p.end, factor * p.radius)) for name, kind, p in PIPES]
    write_plan_ifc(tmp_path / "plan.ifc", pipes)
    with pytest.raises(InputError, match=f"{told}: the unit of length that the file names is not that of its"):
        load_boq(tmp_path / "plan.ifc")


@needs_ifc
def test_a_file_that_is_cut_off_is_told(tmp_path: Path) -> None:
    path = tmp_path / "plan.ifc"
    write_plan_ifc(path, PIPES)
    text = path.read_text()
    path.write_text(text[: text.rindex("IFCPIPESEGMENT(")])
    with pytest.raises(InputError, match="is cut off: END-ISO-10303-21; is missing"):
        load_boq(path)


def test_without_ifcopenshell_it_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    (tmp_path / "plan.ifc").write_text("ISO-10303-21;")
    with pytest.raises(InputError, match="pip install ifcopenshell=="):
        load_boq(tmp_path / "plan.ifc")


@needs_ifc
def test_a_file_that_ends_the_reader_s_process_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plan.ifc").write_text("ISO-10303-21;")
    ended = subprocess.CompletedProcess([], -11, b"", b"")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: ended)
    with pytest.raises(InputError, match=r"plan\.ifc cannot be read as IFC \(its reader ended with code -11\)"):
        load_boq(tmp_path / "plan.ifc")
