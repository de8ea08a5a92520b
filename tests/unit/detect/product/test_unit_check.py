# SPDX-License-Identifier: Apache-2.0
"""Bills whose sizes can only be metres, inches or diameters: asked before the run, with the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.standard_sizes import SIZES


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
    for size in SIZES.values():
        load_boq(bill(tmp_path, key, [round(share * 1e3 * size.outer_diameter, 4)]))


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
