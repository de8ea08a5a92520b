# SPDX-License-Identifier: Apache-2.0
"""Mistakes of users with files: each is told with the file, what it is, and the remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.recording.bag_folder import parts
from pipeprog_bringup.results.scored_files import read_result, read_truth
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_sfm.boards.board import symmetries
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.boards.board_print import board_pdf

ROOT = Path(__file__).parents[3]
BOQ = "classes: [{name: DN65, outer_radius_mm: 36.5, planned_length_m: 3.0}]\n"
BOARD = "boards: [{name: A, circle_radius_mm: 20, centres_mm: [[0, 0], [200, 0], [0, 150]]}]\n"
TWICE = BOQ[:-2] + ", {name: B, outer_radius_mm: 36.5, planned_length_m: 1}]"
ENTRY = "classes:\n  - {name: A, planned_length_m: 3, %s}\n"
MISTAKES: list[tuple[str, Callable[[Path], Any], str | bytes, str]] = [
    ("board as bill", load_boq, BOARD, "it is a board file, which --board takes: are two files swapped"),
    ("bill as board", load_board_file, BOQ, "it is a bill of quantities, which --boq takes: are two files swapped"),
    ("bill as calibration", read_camera_file, BOQ, "it is a bill of quantities, which --boq takes"),
    ("picture as calibration", read_camera_file, b"\xff\xd8\xff\xe0" + bytes(99), "is a JPEG image, not a text file"),
    (
        "truth as result",
        read_result,
        '{"pipes": [], "camera_to_world": []}',
        "holds a site's ground truth: give the results first",
    ),
    ("result as truth", read_truth, '{"scale": {}, "pipes": [], "classes": []}', "give the results first"),
    ("metres", load_boq, ENTRY % "outer_radius_mm: 0.1095", "metres"),
    ("decimal comma", load_boq, ENTRY % "outer_radius_mm: 57,5", "Write 57.5 for 57,5"),
    ("decimal comma, quoted", load_boq, ENTRY % "outer_radius_mm: '57,5'", "write 57.5, with a decimal point"),
    ("inches", load_boq, ENTRY % "size: '4\"'", "did you mean 'NPS 4 steel'?"),
    ("negative", load_boq, BOQ.replace("3.0", "-3"), "write a number above zero"),
    ("with its unit", load_boq, BOQ.replace("3.0", "24 m"), "write a number"),
    ("wrong key", load_boq, BOQ.replace("outer_radius_mm", "outer_radius"), "did you mean 'outer_radius_mm'?"),
    ("size without material", load_boq, ENTRY % "size: DN 100", "did you mean 'DN100 steel'?"),
    ("tab", load_boq, "classes:\n\t- {name: A}\n", "line 2: is no YAML"),
    ("tab, remedy", load_boq, "classes:\n\t- {name: A}\n", "it has a tab: indent with spaces"),
    ("no dash", load_boq, "classes:\n  - name: A\n  outer_radius_mm: 5\n", "begins with a dash"),
    ("open bracket", load_boq, "classes: [{name: A\n", "a bracket is open"),
    ("two circles", load_board_file, BOARD.replace(", [0, 150]", ""), "2 circles, but a board needs 3"),
    (
        "one radius twice",
        load_boq,
        BOQ[:-2] + ", {name: B, outer_radius_mm: 36.5, planned_length_m: 1}]",
        "or give each",
    ),
]


@pytest.mark.parametrize(
    ("read", "content", "expected"), [row[1:] for row in MISTAKES], ids=[row[0] for row in MISTAKES]
)
def test_a_mistake_is_told_with_the_file_and_the_remedy(
    tmp_path: Path, read: Callable[[Path], Any], content: str | bytes, expected: str
) -> None:
    file = tmp_path / "given.yaml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as told:
        read(file)
    assert "given.yaml" in str(told.value)
    assert expected in str(told.value)


def test_a_recording_that_is_not_there_is_told_with_one_that_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no recording"):
        parts(tmp_path / "walk_1.mcap")
    (tmp_path / "walk1.mcap").touch()
    (tmp_path / "walk1.yaml").touch()
    with pytest.raises(InputError, match=r"walk_1\.mcap: did you mean 'walk1\.mcap'\?"):
        parts(tmp_path / "walk_1.mcap")
    with pytest.raises(InputError, match="there is no folder"):
        parts(tmp_path / "gone" / "walk1.mcap")


def test_two_systems_of_one_radius_are_one_class_of_two_lines(tmp_path: Path) -> None:
    file = tmp_path / "boq.yaml"
    line = "{{name: {0}, system: {0}, outer_radius_mm: 57.5, planned_length_m: 3}}"
    file.write_text(f"classes: [{line.format('heating')}, {line.format('water')}]")
    (planned,) = load_boq(file).classes
    assert [one.system for one in planned.lines] == ["heating", "water"]


@pytest.mark.parametrize("paper", ["A4", "A3"])
def test_the_boards_that_are_shipped_fit_on_their_paper_and_have_no_symmetry(paper: str) -> None:
    (board,) = load_board_file(ROOT / "boards" / f"{paper.lower()}.yaml").boards
    assert board_pdf([board], paper).startswith(b"%PDF")
    assert len(symmetries(board)) == 1
