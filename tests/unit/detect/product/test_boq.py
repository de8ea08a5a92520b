# SPDX-License-Identifier: Apache-2.0
"""Bills of quantities: what is read, and what a wrong one is told."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.class_colors import NAMED_COLORS


def written(folder: Path, text: str) -> Path:
    path = folder / "boq.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def entry(text: str) -> str:
    return f"classes: [{{name: DN65, planned_length_m: 3.0, {text}}}]"


def test_radius_or_diameter_and_colours(tmp_path: Path) -> None:
    text = """
classes:
  - {name: DN100, outer_radius_mm: 57.5, planned_length_m: 24.0}
  - {name: DN65, outer_diameter_mm: 73, planned_length_m: 3, color: '#ff8000'}
  - {name: 17, outer_radius_mm: 20, planned_length_m: 2.0, color: Teal}
  - {name: odd, outer_radius_mm: 44, planned_length_m: 2.0}
  - {name: odder, outer_radius_mm: 45, planned_length_m: 2.0}
"""
    classes = load_boq(written(tmp_path, text)).classes
    assert [c.name for c in classes] == ["DN100", "DN65", "17", "odd", "odder"]
    assert [c.outer_radius for c in classes] == pytest.approx([0.0575, 0.0365, 0.02, 0.044, 0.045])
    assert classes[0].color == NAMED_COLORS["cyan"]
    assert classes[1].color == pytest.approx((1.0, 128 / 255, 0.0))
    assert classes[2].color == NAMED_COLORS["teal"]
    assert len({c.color for c in classes}) == 5
    assert all(0 < c.tolerance < 0.02 * c.outer_radius for c in classes)


def test_colours_that_css_names(tmp_path: Path) -> None:
    (tomato,) = load_boq(written(tmp_path, entry("outer_radius_mm: 36.5, color: Tomato"))).classes
    assert tomato.color == pytest.approx((1.0, 99 / 255, 71 / 255))


@pytest.mark.parametrize(
    ("size", "diameter_mm"),
    [
        ("DN50 steel", 60.3),
        ("steel dn 50", 60.3),
        ("NPS 2-1/2 steel", 73.0),
        ('NPS 2" steel', 60.3),
        ("DN150 steel", 168.3),
        ("DN150 EN 10255 steel", 165.1),
        ("NPS 5 steel", 141.3),
        ("22 copper", 22.0),
        ("267 copper", 267.0),
        ("copper 22 mm", 22.0),
        ("DN110 PVC", 110.0),
    ],
)
def test_standard_sizes(tmp_path: Path, size: str, diameter_mm: float) -> None:
    (planned,) = load_boq(written(tmp_path, entry(f"size: '{size}'"))).classes
    assert planned.outer_radius == pytest.approx(0.5e-3 * diameter_mm)
    assert 0 < planned.tolerance < 0.02 * planned.outer_radius


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("classes: []", "list at least one class"),
        ("", "begins with 'classes:'"),
        ("- 1", "begins with 'classes:'"),
        ("classes: {a: [", "is no YAML"),
        ("clases: [{name: a}]", "did you mean 'classes'"),
        ("classes: [3]", "class 1 is 3"),
        ("classes: [{outer_radius_mm: 3, planned_length_m: 1}]", "give each class a name"),
        (entry("outer_radius_mm: -3"), "outer_radius_mm is -3: write a number above zero"),
        (entry("outer_radius_mm: 0"), "write a number above zero"),
        (entry("outer_radius_mm: .nan"), "write a number above zero"),
        (entry("outer_radius_mm: wide"), "outer_radius_mm is 'wide': write a number"),
        (entry("outer_radius_mm: true"), "write a number"),
        (
            entry("outer_radius_mm: 3, outer_diameter_mm: 6"),
            "needs one of outer_radius_mm, outer_diameter_mm, size, not outer_radius_mm and outer_diameter_mm",
        ),
        (entry("color: red"), "needs one of outer_radius_mm, outer_diameter_mm, size, not none"),
        (entry("outer_radius_mm: 3, colour: red"), "unknown key 'colour' in class 'DN65': did you mean 'color'"),
        (entry("outer_radius_mm: 30, wall_mm: 40"), "wall_mm is 40, more than the radius"),
        (entry("outer_radius_mm: 30, wall_mm: -1"), "wall_mm is -1: write a number above zero"),
        (entry("size: DN50 stell"), "unknown size 'DN50 stell': did you mean 'DN50 steel'"),
        (entry("size: 3"), "unknown size '3': did you mean"),
        (entry("outer_radius_mm: 3, color: gren"), "did you mean 'green'"),
        ("classes: [{name: a, outer_radius_mm: 3}]", "has no planned_length_m"),
        ("classes: [{name: a, outer_radius_mm: 3, planned_length_m: -1}]", "planned_length_m is -1"),
        (
            "classes: [{name: a, outer_radius_mm: 3, planned_length_m: 1}, "
            "{name: a, outer_radius_mm: 4, planned_length_m: 1}]",
            "listed twice",
        ),
        (
            "classes: [{name: a, outer_radius_mm: 3, planned_length_m: 1}, "
            "{name: b, outer_diameter_mm: 6, planned_length_m: 1}]",
            "cannot be told apart",
        ),
    ],
)
def test_a_wrong_boq_is_reported_with_its_remedy(tmp_path: Path, text: str, told: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_boq(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (entry("outer_radius_mm: 3").replace("DN65", "2001-99-99") + "\nclases: 1", "unknown key 'clases'"),
        (entry("outer_radius_mm: 3").replace("DN65", '"a\\nb"'), "write a name on one line"),
        (entry("outer_radius_mm: 3").replace("DN65", "x" * 257), "a name of 257 characters"),
        (entry("outer_radius_mm: 3").replace("DN65", "[a]"), "the name of class 1 is ['a']: write a name"),
        (entry("outer_radius_mm: 1.0e+400"), "outer_radius_mm is inf: write a number above zero"),
        (entry("outer_radius_mm: 1" + "0" * 90), "is that of no pipe"),
        (entry("outer_radius_mm: 1.0e-300"), "is that of no pipe"),
        (entry("outer_radius_mm: 3").replace("3.0", "1" + "0" * 90), "planned_length_m is 1e+90: write metres"),
        ("classes:\n" + "- {name: a}\n" * 1001, "1001 classes: plan 1000 at most"),
        (f"a: &a [{'x,' * 900}]\nb: &b [{'*a,' * 900}]\nclasses: *b", "line 3: more than 1000000 values"),
        (f"classes: {{a: &a [{'x,' * 900}], b: [{'*a,' * 900}]}}", "classes is {'a': ['x', 'x', 'x', 'x', …]"),
        (f"classes: [{{name: [&a [{'x,' * 900}], {'*a,' * 900}]}}]", "class 1 is [["),
        (entry("outer_radius_mm: 3, color: [&a [x, x], *a]"), "color is [['x', 'x'], ['x', 'x']]: write a name"),
        (entry("size: {a: b}"), "size is {'a': 'b'}: write a name"),
        (entry("size: " + "9" * 99), "unknown size '9999"),
        ("classes:\n- name: a\n  outer_radius_mm: 3\n  planned_length_m: 1\n- 3", "line 5: class 2 is 3"),
    ],
    ids=lambda text: repr(text)[:40],
)
def test_a_hostile_boq_is_reported_with_its_remedy(tmp_path: Path, text: str, told: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError, match="^" + re.escape(str(path))) as caught:
        load_boq(path)
    assert told in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 400


def test_a_bill_of_as_many_classes_as_there_may_be_is_read_at_once(tmp_path: Path) -> None:
    rows = [f"- {{name: c{k}, outer_radius_mm: {10 + k}, planned_length_m: 1}}" for k in range(1000)]
    start = time.process_time()
    assert len(load_boq(written(tmp_path, "classes:\n" + "\n".join(rows))).classes) == 1000
    assert time.process_time() - start < 10.0


def test_a_wall_is_for_cameras_inside(tmp_path: Path) -> None:
    (planned,) = load_boq(written(tmp_path, entry("outer_diameter_mm: 200, wall_mm: 5.9"))).classes
    assert planned.bores == ((pytest.approx(0.0941), planned.tolerance),)


def test_a_missing_boq_is_reported_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file: .*none\.yaml"):
        load_boq(tmp_path / "none.yaml")


def test_radii_that_no_survey_tells_apart_are_refused(tmp_path: Path) -> None:
    rows = """classes:
  - {{name: a, outer_radius_mm: 57.5, planned_length_m: 3, system: heating{0}}}
  - {{name: b, outer_radius_mm: {1}, planned_length_m: 2, system: water{2}}}
"""
    with pytest.raises(
        InputError, match=r"line 2: classes 'a' and 'b' have outer radii of 57\.5 and 57\.52 mm, .*: write"
    ):
        load_boq(written(tmp_path, rows.format("", 57.52, "")))
    for apart in (("", 57.8, ""), (", material: copper", 57.52, ", material: steel")):
        assert len(load_boq(written(tmp_path, rows.format(*apart))).classes) == 2
