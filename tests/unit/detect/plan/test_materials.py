# SPDX-License-Identifier: Apache-2.0
"""Materials in a bill, and classes of one radius told apart by them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeprog_camera.errors import InputError
from pipeprog_detect.plan.materials import read_material
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_detect.product.classification import asks_look, classified_by_look, classify
from pipeprog_detect.types import Cylinder, Pipe

LINE = "  - {{name: {0}, outer_radius_mm: {1}, planned_length_m: 3, {2}}}\n"


def bill(folder: Path, *lines: tuple[str, float, str]) -> BillOfQuantities:
    (folder / "boq.yaml").write_text("classes:\n" + "".join(LINE.format(*line) for line in lines))
    return load_boq(folder / "boq.yaml")


def of_radius(radius: float, boq: BillOfQuantities) -> Pipe:
    verdict = classify(radius, 2e-4, boq)
    cylinder = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), radius)
    return Pipe("p01", cylinder, 2e-4, verdict.name, verdict.probability, 2.0, 1e-3, 1000)


@pytest.mark.parametrize(
    ("text", "material"),
    [
        ("Steel", "steel"),
        ("grey PVC", "PVC grey"),
        ("PVC-gray", "PVC grey"),
        ("PE black", "black PE"),
        ("verzinkt", "galvanised"),
        ("rot lackiert", "painted red"),
        ("P235GH", "P235GH"),
    ],
)
def test_a_material_is_known_by_its_words(text: str, material: str) -> None:
    assert read_material("boq.yaml", text) == material


def test_a_slip_of_the_pen_is_asked_about() -> None:
    with pytest.raises(InputError, match=r"boq\.yaml: unknown material 'coper': did you mean 'copper'\?"):
        read_material("boq.yaml", "coper")


def test_lines_of_one_radius_are_classes_of_their_own_where_each_names_its_material(tmp_path: Path) -> None:
    boq = bill(tmp_path, ("heating", 57.5, "material: steel"), ("waste", 57.5, "material: PVC grey"))
    assert [(planned.name, planned.material) for planned in boq.classes] == [
        ("heating", "steel"),
        ("waste", "PVC grey"),
    ]
    assert boq.radii == (0.0575,)


def test_lines_of_one_material_are_one_class(tmp_path: Path) -> None:
    steel = "material: steel, system"
    boq = bill(tmp_path, ("a", 57.5, f"{steel}: x"), ("b", 57.5, f"{steel}: y"), ("c", 57.5, "material: copper"))
    assert [(planned.name, len(planned.lines)) for planned in boq.classes] == [("a + b", 2), ("c", 1)]


@pytest.mark.parametrize("other", ["material: P235GH", "system: water"])
def test_a_line_without_a_material_that_can_be_seen_joins_its_size(tmp_path: Path, other: str) -> None:
    (planned,) = bill(tmp_path, ("a", 57.5, "material: steel, system: heating"), ("b", 57.5, other)).classes
    assert len(planned.lines) == 2
    assert planned.material == ""


def test_a_table_names_materials_too(tmp_path: Path) -> None:
    (tmp_path / "boq.csv").write_text(
        "Bezeichnung;Außendurchmesser [mm];Länge [m];Werkstoff\nHeizung;114,3;12,5;Stahl\nAbwasser;114,3;8,5;PVC grau\n"
    )
    assert [planned.material for planned in load_boq(tmp_path / "boq.csv").classes] == ["steel", "PVC grey"]


def test_the_look_decides_between_classes_of_one_radius(tmp_path: Path) -> None:
    boq = bill(tmp_path, ("heating", 57.5, "material: steel"), ("water", 57.5, "material: copper"))
    pipe = of_radius(0.0575, boq)
    assert pipe.class_name is None
    assert asks_look(pipe, boq)
    told = classified_by_look(pipe, boq, {"steel": 0.01, "copper": 0.6, "painted red": 0.39})
    assert (told.class_name, told.material) == ("water", "copper")
    assert told.class_probability == told.material_probability == pytest.approx(0.6 / 0.61)


@pytest.mark.parametrize("look", [{"steel": 0.5, "copper": 0.4}, {"painted red": 0.99, "copper": 0.01}])
def test_a_look_that_does_not_tell_leaves_the_class_open(tmp_path: Path, look: dict[str, float]) -> None:
    boq = bill(tmp_path, ("heating", 57.5, "material: steel"), ("water", 57.5, "material: copper"))
    told = classified_by_look(of_radius(0.0575, boq), boq, look)
    assert (told.class_name, told.material) == (None, "")
    assert told.class_probability > 0.0
    assert told.material_probability > 0.0


def test_radius_and_look_are_weighed_together(tmp_path: Path) -> None:
    boq = bill(tmp_path, ("28", 14.0, "material: copper"), ("DN20", 13.45, "material: steel"))
    pipe = of_radius(0.0137, boq)
    assert pipe.class_name is None
    assert classified_by_look(pipe, boq, {"steel": 0.9, "copper": 0.02}).class_name == "DN20"


@pytest.mark.parametrize("second", [("DN65", 36.5, "material: copper"), ("DN100", 57.2, "material: steel")])
def test_the_look_is_not_asked_where_it_could_not_help(tmp_path: Path, second: tuple[str, float, str]) -> None:
    boq = bill(tmp_path, ("heating", 57.5, "material: steel"), second)
    assert not asks_look(of_radius(0.0575, boq), boq)
