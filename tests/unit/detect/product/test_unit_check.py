# SPDX-License-Identifier: Apache-2.0
"""Bills whose sizes can only be metres, inches or diameters: asked before the run, with the remedy."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.standard_sizes import SIZES, named_diameters

ROOT = Path(__file__).parents[4]
UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4}


def named_bill(folder: Path, key: str, sizes: dict[str, float], more: str = "") -> Path:
    path = folder / "boq.yaml"
    rows = [f"- {{name: {name}, {key}: {number!r}, planned_length_m: 3{more}}}" for name, number in sizes.items()]
    path.write_text("classes:\n" + "\n".join(rows) + "\n")
    return path


def bill(folder: Path, key: str, numbers: list[float]) -> Path:
    path = folder / "boq.yaml"
    rows = [f"- {{name: c{k}, {key}: {number!r}, planned_length_m: 3}}" for k, number in enumerate(numbers)]
    path.write_text("classes:\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(
    ("key", "numbers", "told"),
    [
        ("outer_radius_mm", [0.1095], "are these metres? Then write outer_radius_mm: 109.5"),
        ("outer_radius_mm", [0.0575, 0.0841, 0.1095], "are these metres? Then write outer_radius_mm: 57.5"),
        ("outer_radius_mm", [36.5, 0.1095], "'c1': outer_radius_mm is 0.1095: are these metres?"),
        ("outer_diameter_mm", [0.219, 0.115], "are these metres? Then write outer_diameter_mm: 219"),
        ("outer_diameter_mm", [4.5, 2.375, 8.625], "is 2.375: are these inches? Then write outer_diameter_mm: 60.325"),
        ("outer_radius_mm", [2.25, 4.3125], "are these inches? Then write outer_radius_mm: 57.15"),
        (
            "outer_radius_mm",
            [114.3, 60.3, 168.3],
            "are these diameters? Then write outer_diameter_mm: 114.3, or outer_diameter_mm: 228.6 if it is a radius",
        ),
        ("outer_radius_mm", [2.875, 4.5], "are these diameters in inches? Then write outer_diameter_mm: 73.025"),
        ("outer_radius_mm", [3.8, 5.7], "are these centimetres? Then write outer_radius_mm: 38"),
        ("outer_diameter_mm", [7.6, 11.4], "are these centimetres? Then write outer_diameter_mm: 76"),
    ],
)
def test_another_unit_is_asked_about(tmp_path: Path, key: str, numbers: list[float], told: str) -> None:
    path = bill(tmp_path, key, numbers)
    with pytest.raises(InputError) as caught:
        load_boq(path)
    assert told in str(caught.value)
    assert f"{path}, line " in str(caught.value)


@pytest.mark.parametrize("key", ["outer_radius_mm", "outer_diameter_mm"])
def test_no_standard_size_is_asked_about(tmp_path: Path, key: str) -> None:
    share = 0.5 if key == "outer_radius_mm" else 1.0
    for name, size in SIZES.items():
        load_boq(bill(tmp_path, key, [round(share * 1e3 * size.outer_diameter, 4)]))
        for digits in (1, 4):
            load_boq(named_bill(tmp_path, key, {name: round(share * 1e3 * size.outer_diameter, digits)}))


@pytest.mark.parametrize("tube", [6.35, 9.52, 15.88, 20.0, 26.0])
def test_no_tube_that_has_no_name_is_asked_about(tmp_path: Path, tube: float) -> None:
    load_boq(bill(tmp_path, "outer_diameter_mm", [tube]))


@pytest.mark.parametrize("path", sorted((ROOT / "bags").glob("*.boq.yaml")), ids=lambda path: path.name)
def test_no_bill_of_a_recording_is_asked_about(path: Path) -> None:
    load_boq(path)


@pytest.mark.parametrize("key", ["outer_radius_mm", "outer_diameter_mm"])
@pytest.mark.parametrize(("unit", "millimetres"), UNITS_MM.items())
def test_every_nominal_size_in_another_unit_is_asked_about(
    tmp_path: Path, key: str, unit: str, millimetres: float
) -> None:
    share = 0.5 if key == "outer_radius_mm" else 1.0
    for name, size in SIZES.items():
        if named_diameters(name):
            number = float(f"{share * 1e3 * size.outer_diameter / millimetres:.5g}")
            with pytest.raises(InputError, match=rf"are these {unit}\?"):
                load_boq(named_bill(tmp_path, key, {name: number}))


@pytest.mark.parametrize(
    ("key", "sizes", "told"),
    [
        ("outer_radius_mm", {"NPS 8": 8.625, "NPS12": 12.75}, "diameters in inches? Then write outer_diameter_mm: 219"),
        ("outer_radius_mm", {"NPS 2": 2.375, "NPS 4": 4.5, "NPS 8": 8.625}, "diameters in inches?"),
        ("outer_radius_mm", {"NPS 2-1/2 riser": 2.875}, "diameters in inches? Then write outer_diameter_mm: 73.025"),
        (
            "outer_radius_mm",
            {"DN65": 3.805, "DN100": 5.715},
            "centimetres? Then write outer_radius_mm: 38.05",
        ),
        ("outer_radius_mm", {"DN100": 57.15, "DN65": 3.65}, "class 'DN65': outer_radius_mm is 3.65: are these centim"),
        (
            "outer_diameter_mm",
            {"DN100": 57.15},
            "are these radii? Then write outer_radius_mm: 57.15, or outer_",
        ),
        ("outer_diameter_mm", {"DN65": 65, "DN100": 100}, "is it the nominal size? Then write outer_diameter_mm: 76.1"),
        ("outer_radius_mm", {"DN65": 65, "DN100": 100}, "is it the nominal size?"),
        ("outer_radius_mm", {"DN65": 32.5, "DN100": 50}, "is it the nominal size?"),
        ("outer_radius_mm", {"DN20": 20}, "is it the nominal size?"),
    ],
)
def test_the_size_in_the_name_tells_the_unit(tmp_path: Path, key: str, sizes: dict[str, float], told: str) -> None:
    with pytest.raises(InputError) as caught:
        load_boq(named_bill(tmp_path, key, sizes))
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("key", "sizes", "more"),
    [
        ("outer_diameter_mm", {"DN50 PVC": 50, "DN110": 110, "DN125": 125}, ""),  # of PVC the DN is the diameter
        ("outer_diameter_mm", {"DN300 sewer": 300, "DN150 sewer": 150}, ""),  # the bore
        ("outer_diameter_mm", {"DN100": 110, "DN50": 54}, ""),  # cast iron, copper
        ("outer_diameter_mm", {"DN15": 15, "DN20": 20, "DN25": 25}, ""),  # tubes of copper and plastic
        ("outer_radius_mm", {"DN65": 36.5, "DN150": 84.1, "DN225": 122.3}, ""),  # ASME, and no standard
        ("outer_radius_mm", {"DN50 in 30 mm of wool": 60.15}, ", material: insulated"),
    ],
)
def test_a_size_that_only_looks_like_another_one_of_its_name_is_taken(
    tmp_path: Path, key: str, sizes: dict[str, float], more: str
) -> None:
    assert len(load_boq(named_bill(tmp_path, key, sizes, more)).classes) == len(sizes)


def test_lengths_in_millimetres_are_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "boq.csv"
    path.write_text("name,size,length [m],zone\nA,DN65 steel,3200,\n")
    with pytest.raises(InputError, match=r"row 2: class 'A': planned_length_m is 3200: .* planned_length_m: 3\.2; if"):
        load_boq(path)
    path.write_text("name,size,length [m],zone\nA,DN65 steel,1000,1\nA,DN65 steel,1000,2\nB,DN50 steel,1906.25,\n")
    assert math.fsum(planned.planned_length for planned in load_boq(path).classes) == pytest.approx(3906.25)


def test_sizes_that_are_standard_in_no_unit_are_taken_as_they_are(tmp_path: Path) -> None:
    assert load_boq(bill(tmp_path, "outer_radius_mm", [97.15, 44.0])).classes[0].outer_radius == pytest.approx(0.09715)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{name: a, outer_radius_mm: 57,5, planned_length_m: 3}", "is it behind a decimal comma? Write 57.5 for 57,5"),
        ("{name: a, outer_radius_mm: '57,5', planned_length_m: 3}", "write 57.5, with a decimal point"),
    ],
)
def test_decimal_commas_in_yaml_are_recognised(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "boq.yaml"
    path.write_text(f"classes: [{text}]")
    with pytest.raises(InputError, match="class 'a'") as caught:
        load_boq(path)
    assert told in str(caught.value)


def test_one_diameter_among_radii_is_asked_about(tmp_path: Path) -> None:
    """The others are right, and a radius of 114.3 mm is that of DN225; but this class says that it is DN100."""
    path = tmp_path / "boq.yaml"
    rows = """
  - {{name: DN65, outer_radius_mm: 38.05, planned_length_m: 3}}
  - {{name: {}, outer_radius_mm: 114.3, planned_length_m: 3}}
"""
    path.write_text("classes:" + rows.format("cold water DN100"))
    with pytest.raises(InputError, match=r"are these diameters\? Then write outer_diameter_mm: 114\.3"):
        load_boq(path)
    path.write_text("classes:" + rows.format("DN225"))
    assert len(load_boq(path).classes) == 2
