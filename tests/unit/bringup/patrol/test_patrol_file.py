# SPDX-License-Identifier: Apache-2.0
"""PATROL.yaml and the state of a patrol: what is written is what is read, and mistakes are named with their line."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup.patrol.patrol_file import MOVE_SECONDS, Patrol, Place, read_patrol
from pipeprog_bringup.patrol.patrol_state import DONE, PatrolState, PlaceState
from pipeprog_camera.errors import InputError


def read(tmp_path: Path, text: str) -> Patrol:
    path = tmp_path / "site.patrol.yaml"
    path.write_text(text)
    return read_patrol(path)


def test_a_place_has_what_it_says_and_what_all_say(tmp_path: Path) -> None:
    patrol = read(
        tmp_path,
        "boq: site.yaml\nreference: 'first_{place}'\ngo_to: [walk, '{place}']\nhome: [walk, dock]\nplaces:\n"
        "- {name: level1, film: [walk, '{place}_end'], board: /boards/a.yaml}\n"
        "- {name: level2, seconds: 30, go_to: [fly]}\n",
    )
    boq = str(tmp_path / "site.yaml")
    assert patrol.home == ("walk", "dock")
    assert patrol.places == (
        Place(
            "level1",
            ("walk", "level1"),
            ("walk", "level1_end"),
            0.0,
            MOVE_SECONDS,
            boq,
            "/boards/a.yaml",
            "first_level1",
        ),
        Place("level2", ("fly",), (), 30.0, MOVE_SECONDS, boq, "", "first_level2"),
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("places: []", ["places", "at least one"]),
        ("- a", ["places:"]),
        ("places: [level1]", ["line 1", "name"]),
        ("places:\n- {name: ../up, seconds: 3}", ["line 2", "'../up'", "folder"]),
        ("places:\n- {name: a, seconds: 3}\n- {name: a, seconds: 3}", ["line 3", "'a'", "above"]),
        ("places:\n- {name: a}", ["line 2", "film", "seconds"]),
        ("places:\n- {name: a, film: walk there}", ["line 2", "film", "list"]),
        ("places:\n- {name: a, film: []}", ["line 2", "film", "list"]),
        ("places:\n- {name: a, seconds: .nan}", ["seconds", "86400"]),
        ("places:\n- {name: a, seconds: -1}", ["seconds", "-1"]),
        ("places:\n- {name: a, secnds: 1}", ["secnds", "seconds"]),
        ("places:\n- {name: a, seconds: 1, boq: [x]}", ["boq", "name"]),
        ("places:\n- {name: a, seconds: 1, reference: [x]}", ["reference", "name"]),
        ("plces:\n- {name: a, seconds: 1}", ["plces", "places"]),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert all(word in str(error.value) for word in words), error.value


def test_the_state_is_read_as_it_was_saved(tmp_path: Path) -> None:
    path = tmp_path / "patrol.json"
    state = PatrolState(path, ["a", "b"])
    state.places["a"] = PlaceState(DONE, 2, "monday_a_2", "/surveys/monday_a_2")
    state.save()
    again = PatrolState(path, ["b", "c"])
    assert again.places["a"] == state.places["a"]  # its folder is there, though the patrol has the place no more
    assert list(again.places) == ["b", "c", "a"]
    assert [file.name for file in tmp_path.iterdir()] == ["patrol.json"]


@pytest.mark.parametrize(
    "text",
    ["[]", "{", '{"places": {"a": 3}}', '{"places": {"a": {"state": "x"}}}', '{"places": {"a": {"attempts": -1}}}'],
)
def test_a_file_that_is_no_state_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "patrol.json").write_text(text)
    with pytest.raises(InputError, match=r"patrol\.json"):
        PatrolState(tmp_path / "patrol.json", ["a"])
