# SPDX-License-Identifier: Apache-2.0
import time

import numpy as np
import pytest
from targets import BOARD

from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board_file import KnownDistance, ScaleBar, load_board_file

GOOD = """boards:
  - name: A
    circle_radius_mm: 40
    centres_mm: [[-240, 150], [240, 150], [0, 0], [-240, -150], [240, -150]]
"""


def test_reads_the_boards_of_a_file(tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text(GOOD)
    (board,) = load_board_file(path).boards
    assert board.name == "A"
    assert board.circle_radius == 0.04
    assert board.centres == pytest.approx(BOARD.centres)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("boards:", "bords:", ["bords", "boards"]),
        ("    circle_radius_mm: 40\n", "", ["circle_radius_mm", "missing"]),
        ("circle_radius_mm", "circle_radius", ["circle_radius", "circle_radius_mm"]),
        ("circle_radius_mm: 40", "circle_radius_mm: wide", ["wide", "number"]),
        ("circle_radius_mm: 40", "circle_radius_mm: 0.04", ["millimetres"]),
        ("circle_radius_mm: 40", "circle_radius_mm: .nan", ["nan", "number"]),
        ("[-240, 150]", "[-240, x]", ["'x'", "number"]),
        ("[-240, 150]", "[-240]", ["pairs"]),
        (", [0, 0], [-240, -150], [240, -150]", "", ["2 circles"]),
        ("[0, 0], [-240, -150], [240, -150]", "[0, 150]", ["one line"]),
        ("[0, 0]", "[-200, 150]", ["overlap"]),
        (
            "[[-240, 150], [240, 150], [0, 0], [-240, -150], [240, -150]]",
            "[[0, 0], [200, 0], [200, 200], [0, 200]]",
            ["4 ways"],
        ),
        (GOOD, GOOD + GOOD.removeprefix("boards:\n"), ["'A'", "unique"]),
        (GOOD, "boards: [", ["YAML"]),
        (GOOD, "boards: []", ["at least one"]),
        (GOOD, "", ["boards"]),
    ],
)
def test_refuses_a_bad_file_and_says_why(tmp_path, old, new, words):
    path = tmp_path / "board.yaml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_board_file(path)
    for word in [*words, str(path)]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("name: A", "name: [A]", ["line 2", "['A']", "write a name"]),
        ("name: A", 'name: "A\\e[31m"', ["line 2", "control character"]),
        ("circle_radius_mm: 40", "circle_radius_mm: 1" + "0" * 400, ["line 3", "401 characters"]),
        ("circle_radius_mm: 40", "circle_radius_mm: 1" + "0" * 90, ["beyond any site"]),
        ("[0, 0]", "[0, {a: b}]", ["{'a': 'b'}", "number"]),
        ("[0, 0]", ", ".join(f"[{k % 20}00, {k // 20}00]" for k in range(257)), ["board needs 3 to 256"]),
        ("[0, 0]", ", ".join(["[0, 0]"] * 20_000), ["20004 circles", "2000 at most"]),
        (GOOD, GOOD + "distances: [" + "1," * 1001 + "]", ["1001 distances"]),
        (GOOD, "marks: [" + "1," * 1001 + "]", ["2002 circles"]),
        (GOOD, "boards: [" + "1," * 2001 + "]", ["2001 circles"]),
        (GOOD, f"boards: [[&a [{'x,' * 900}], {'*a,' * 900}]]", ["board 1", "expected the keys"]),
        (GOOD, GOOD + "  - {name: B, name: C}\n", ["line 5", "line 5 already"]),
    ],
    ids=lambda text: repr(text)[:40],
)
def test_refuses_a_hostile_file_and_says_why(tmp_path, old, new, words):
    path = tmp_path / "board.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_board_file(path)
    for word in [*words, str(path)]:
        assert word in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 400


def test_boards_of_as_many_circles_as_there_may_be_are_read_at_once(tmp_path):
    path = tmp_path / "board.yaml"
    angles = np.arange(256) * (2 * np.pi / 257)  # a ring with a gap, on which all turns must be tried
    ring = [[round(float(9000 * np.cos(angle)), 3), round(float(9000 * np.sin(angle)), 3)] for angle in angles]
    rows = [f"  - {{name: b{k}, circle_radius_mm: 40, centres_mm: {ring}}}\n" for k in range(7)]
    path.write_text("boards:\n" + "".join(rows))
    start = time.process_time()
    assert len(load_board_file(path).boards) == 7
    assert time.process_time() - start < 10.0


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="none\\.yaml"):
        load_board_file(tmp_path / "none.yaml")


DISTANCE = "distances:\n  - {from: A/1, to: A/2, distance_mm: 480.2, sigma_mm: 0.5}\n"


def test_reads_the_distances_of_a_file(tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text(GOOD + DISTANCE)
    (distance,) = load_board_file(path).distances
    assert distance == KnownDistance("A/1 to A/2", (("A", 0), ("A", 1)), 0.4802, 0.0005)
    path.write_text(GOOD)
    assert load_board_file(path).distances == ()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("A/2", "A/6", ["'to: A/6'", "A/1"]),
        ("A/2", "B/1", ["B/1"]),
        ("A/2", "A", ["BOARD/NUMBER"]),
        ("A/2", "A/1", ["both ends"]),
        ("sigma_mm: 0.5", "sigma_mm: 0", ["above zero"]),
        ("sigma_mm", "sigma", ["sigma_mm"]),
    ],
)
def test_refuses_a_bad_distance_and_says_why(tmp_path, old, new, words):
    path = tmp_path / "board.yaml"
    path.write_text(GOOD + DISTANCE.replace(old, new))
    with pytest.raises(InputError, match="distance 1") as caught:
        load_board_file(path)
    for word in [*words, str(path)]:
        assert word in str(caught.value)


MARKS = "marks:\n  - {circle_radius_mm: 50, distance_mm: 2134, sigma_mm: 1.5}\n"


def test_reads_marks_with_and_without_boards(tmp_path):
    path = tmp_path / "board.yaml"
    for text, boards in ((MARKS, 0), (GOOD + MARKS, 1)):
        path.write_text(text)
        targets = load_board_file(path)
        assert targets.scale_bars == (ScaleBar("marks 1", 0.05, 2.134, 0.0015),)
        assert len(targets.boards) == boards


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("circle_radius_mm: 50", "circle_radius_mm: 0.05", ["millimetres"]),
        ("distance_mm: 2134", "distance_mm: 90", ["90", "between centres"]),
        ("sigma_mm: 1.5", "sigma_mm: -1", ["above zero"]),
        ("sigma_mm: 1.5", "sigma: 1", ["sigma_mm"]),
        ("marks:\n  - ", "marks: ", ["list"]),
        (MARKS, MARKS + DISTANCE, ["marks", "none"]),
    ],
)
def test_refuses_bad_marks_and_says_why(tmp_path, old, new, words):
    path = tmp_path / "board.yaml"
    path.write_text(MARKS.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_board_file(path)
    for word in [*words, str(path)]:
        assert word in str(caught.value)
