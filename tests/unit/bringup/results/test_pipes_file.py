# SPDX-License-Identifier: Apache-2.0
"""pipes.json read back: each field is checked before anything is computed or drawn of it."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from pipeprog_bringup.results.pipes_file import read_pipes
from pipeprog_camera.errors import InputError

GOOD: dict[str, Any] = {
    "frame_id": "map",
    "scale": {"source": "board", "sigma": 0.001},
    "pipes": [
        {
            "id": "p01",
            "start": [0, 0, 0],
            "end": [1, 0, 0],
            "radius": 0.05,
            "radius_sigma": None,
            "length": 1,
            "class": "DN100",
            "class_probability": 0.9,
            "visible_arc_deg": 90.0,
            "rmse": 0.001,
            "points": 9,
            "length_sigma": 0.002,
            "ends": [{"state": "free", "sigma": 0.001}, {"state": "wall", "sigma": None}],
        }
    ],
    "classes": [{"class": "DN100", "outer_radius": 0.05, "planned_m": 2, "installed_m": 1, "percent": 50}],
    "runs": [],
}


def changed(key: str, value: Any, rows: str | None = "pipes") -> dict[str, Any]:
    content = copy.deepcopy(GOOD)
    target = content if rows is None else content[rows][0]
    target[key] = value
    return content


def test_a_pipes_json_is_read(tmp_path: Path) -> None:
    path = tmp_path / "pipes.json"
    path.write_text(json.dumps(GOOD))
    file = read_pipes(path)
    assert (file.pipes, file.classes, file.runs, file.scale) == (GOOD["pipes"], GOOD["classes"], [], GOOD["scale"])


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ({}, "'pipes' is missing"),
        (changed("pipes", 3, None), "pipes is 3, not a list of objects"),
        (changed("pipes", [3], None), r"pipes is \[3\], not a list of objects"),
        (changed("pipes", [{}] * 10_001, None), "10001 pipes, more than 10000"),
        (changed("runs", {}, None), "runs is {}"),
        (changed("scale", [], None), r"scale is \[\]"),
        (changed("scale", {"source": "board", "sigma": "x"}, None), "sigma of the scale is 'x'"),
        (changed("start", [0, 0]), r"start of pipe 1 is \[0, 0\], not three coordinates"),
        (changed("start", [0, 0, "1"]), "start of pipe 1 is '1'"),
        (changed("start", [0, 0, 1e300]), r"start of pipe 1 is 1e\+300, not a number from -1e\+08"),
        (changed("end", [0, 0, 0]), "pipe 1 has no length or radius"),
        (changed("radius", 0), "pipe 1 has no length or radius"),
        (changed("radius", -1), "radius of pipe 1 is -1"),
        (changed("radius", True), "radius of pipe 1 is True"),
        (changed("rmse", []), r"rmse of pipe 1 is \[\]"),
        (changed("points", "many"), "points of pipe 1 is 'many'"),
        (changed("length_sigma", -1), "length_sigma of pipe 1 is -1"),
        (changed("ends", 3), "ends is 3, not a list of objects"),
        (changed("ends", [{"state": 3}]), "state of an end of pipe 1 is 3, not a name"),
        (changed("ends", [{"state": "free", "sigma": "x"}]), "sigma of an end of pipe 1 is 'x'"),
        (changed("installed_sigma_m", "x", "classes"), "installed_sigma_m of class 1 is 'x'"),
        (changed("id", 5), "id of pipe 1 is 5"),
        (changed("id", "\x1b[2J"), "the id of pipe 1 .*without control characters"),
        (changed("class", 5), "class of pipe 1 is 5"),
        (changed("class", "other"), "class 'other' of pipe 1 is not among its classes"),
        (changed("class", "a\nb", "classes"), "the name of class 1 .*on one line"),
        (changed("class", "\ud800", "classes"), "the name of class 1"),
        (changed("planned_m", None, "classes"), "planned_m of class 1 is None"),
    ],
    ids=lambda value: repr(value)[-30:],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: dict[str, Any], error: str) -> None:
    path = tmp_path / "pipes.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=error) as caught:
        read_pipes(path)
    assert f"{path} is no pipes.json of pipeprog" in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300
