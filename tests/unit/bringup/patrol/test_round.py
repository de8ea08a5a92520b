# SPDX-License-Identifier: Apache-2.0
"""A round of the robot against a surveyor that only notes: order, second attempts, and going on after an end."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeprog_bringup.patrol.patrol_file import Patrol, Place
from pipeprog_bringup.patrol.patrol_state import DONE, FAILED, FILMING, PatrolState
from pipeprog_bringup.patrol.round import Round, Surveyed
from pipeprog_camera.errors import InputError

NAMES = ("one", "two", "three")


class Notes:
    """A surveyor whose surveys give `results` in turn, good ones when there are none."""

    def __init__(self, *results: str) -> None:
        self.said: list[str] = []
        self.results = list(results)
        self.refused = 0  # of the next goals
        self._name = ""

    @property
    def is_over(self) -> bool:
        return not self._name

    def start(self, survey_id: str, boq: str, board: str, seconds: float, reference: str) -> None:
        if self.refused:
            self.refused -= 1
            raise InputError("no goal accepted")
        self.said.append(survey_id)
        self._name = survey_id

    def end(self) -> None:
        self.said.append("end")

    def cancel(self) -> None:
        self.said += [] if self.is_over else ["cancel"]

    def result(self) -> Surveyed:
        name, self._name = self._name, ""
        error = self.results.pop(0) if self.results else ""
        return Surveyed(not error, error, f"/surveys/{name}")

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True


def writes(path: Path, word: str) -> tuple[str, ...]:
    """A command that appends a word to a file."""
    return ("sh", "-c", f"echo {word} >> {path}")


def patrol_of(*places: Place, home: tuple[str, ...] = ()) -> Patrol:
    return Patrol(places, home)


def walk(patrol: Patrol, tmp_path: Path, surveyor: Notes) -> tuple[list[str], PatrolState]:
    state = PatrolState(tmp_path / "patrol.json", [place.name for place in patrol.places])
    failed = Round(patrol, state, "monday", surveyor, lambda _: None).run()
    return failed, PatrolState(tmp_path / "patrol.json", [])


def test_each_place_is_surveyed_and_the_robot_goes_home(tmp_path: Path) -> None:
    log = tmp_path / "moves"
    places = [Place(name, writes(log, f"to_{name}"), writes(log, f"film_{name}")) for name in NAMES]
    surveyor = Notes()
    failed, state = walk(patrol_of(*places, home=writes(log, "home")), tmp_path, surveyor)
    assert not failed
    assert log.read_text().split() == [word for name in NAMES for word in (f"to_{name}", f"film_{name}")] + ["home"]
    assert surveyor.said == [word for name in NAMES for word in (f"monday_{name}", "end")]
    assert {place.folder for place in state.places.values()} == {f"/surveys/monday_{name}" for name in NAMES}


def test_a_place_that_fails_is_tried_once_more_at_the_end(tmp_path: Path) -> None:
    places = [Place(name, (), ("true",)) for name in NAMES]
    surveyor = Notes("no scale")
    failed, state = walk(patrol_of(*places), tmp_path, surveyor)
    assert not failed
    assert [word for word in surveyor.said if word != "end"] == [*(f"monday_{name}" for name in NAMES), "monday_one_2"]
    assert state.places["one"].attempts == 2


def test_what_failed_twice_is_told_and_tried_by_the_next_start(tmp_path: Path) -> None:
    patrol = patrol_of(*(Place(name, (), ("true",)) for name in NAMES))
    failed, state = walk(patrol, tmp_path, Notes("", "no scale", "", "no map"))
    assert failed == ["two"]
    assert (state.places["two"].state, state.places["two"].error) == (FAILED, "no map")
    surveyor = Notes()
    failed, state = walk(patrol, tmp_path, surveyor)
    assert not failed
    assert surveyor.said == ["monday_two_3", "end"]


@pytest.mark.parametrize(
    ("command", "word"),
    [(("false",), "ended with 1"), (("/nowhere/walk",), "does not start"), (("sleep", "60"), "has not ended")],
)
def test_a_place_that_the_robot_does_not_reach_is_not_filmed(
    tmp_path: Path, command: tuple[str, ...], word: str
) -> None:
    surveyor = Notes()
    places = (Place("one", command, ("true",), move_seconds=0.1), Place("two", (), ("true",)))
    failed, state = walk(patrol_of(*places), tmp_path, surveyor)
    assert failed == ["one"]
    assert word in state.places["one"].error
    assert surveyor.said == ["monday_two", "end"]


def test_pipes_of_half_a_walk_do_not_count(tmp_path: Path) -> None:
    failed, state = walk(patrol_of(Place("one", (), ("false",))), tmp_path, Notes())
    assert failed == ["one"]
    assert state.places["one"].folder  # they are kept
    assert "ended with 1" in state.places["one"].error


def test_a_goal_that_is_not_accepted_is_an_error_of_its_place(tmp_path: Path) -> None:
    surveyor = Notes()
    surveyor.refused = 2
    failed, state = walk(patrol_of(Place("one", (), ("true",))), tmp_path, surveyor)
    assert failed == ["one"]
    assert state.places["one"].error == "no goal accepted"


def test_after_a_kill_while_filming_the_survey_is_ended_and_the_place_surveyed_anew(tmp_path: Path) -> None:
    patrol = patrol_of(*(Place(name, (), ("true",)) for name in NAMES))
    state = PatrolState(tmp_path / "patrol.json", list(NAMES))
    state.places["one"].state = DONE
    state.places["two"].state, state.places["two"].attempts = FILMING, 1
    state.save()
    surveyor = Notes()
    failed, state = walk(patrol, tmp_path, surveyor)
    assert not failed
    assert surveyor.said == ["end", "monday_two_2", "end", "monday_three", "end"]


def test_a_patrol_that_is_interrupted_frees_the_survey_and_its_commands(tmp_path: Path) -> None:
    class Interrupted(Notes):
        def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
            raise KeyboardInterrupt

    surveyor = Interrupted()
    sleep = (sys.executable, "-c", f"import os, time; open({str(tmp_path / 'pid')!r}, 'w'); time.sleep(60)")
    with pytest.raises(KeyboardInterrupt):
        walk(patrol_of(Place("one", (), sleep)), tmp_path, surveyor)
    assert surveyor.said == ["monday_one", "cancel"]
    assert PatrolState(tmp_path / "patrol.json", []).places["one"].state == FILMING
