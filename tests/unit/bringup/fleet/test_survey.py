# SPDX-License-Identifier: Apache-2.0
"""One survey, without a cluster: what it leaves where, whatever stops it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fsspec", reason="the packages of pipeprog fleet are not installed: make setup FLEET=1")

from pipeprog_bringup.fleet import fingerprint, storage
from pipeprog_bringup.fleet.recordings import Inputs, listed
from pipeprog_bringup.fleet.storage import Place, StorageFailure
from pipeprog_bringup.fleet.survey import survey
from pipeprog_bringup.fleet.task import Outcome, Refused, SurveyFailure, Task, Unwanted, Watcher
from tests.unit.bringup.fleet.stand_ins import BOQ, survey_by_plan, write_results


class Waiting:
    """Someone who waits, for as long as `wanted`."""

    def __init__(self, wanted: bool = True) -> None:
        self.wanted = wanted
        self.stages: list[str] = []

    def is_wanted(self) -> bool:
        return self.wanted

    def tell(self, state: dict[str, Any]) -> None:
        self.stages.append(state["stage"])


def find(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
    """A runner that finds as many metres as the recording has bytes."""
    (recording,) = (folder / "recording").iterdir()
    write_results(folder / "results", len(recording.read_bytes()))
    return {"peak_mb": 700}


def task_of(address: str, out: str) -> Task:
    (recording,) = listed(address, Inputs(boq="boq.yaml"))
    return Task(recording, ".yaml", BOQ.encode(), b"", out, "1", 2, 1000)


def do(task: Task, folder: Path, runner: Any = find, watcher: Waiting | None = None) -> Outcome:
    folder.mkdir()
    return survey(task, folder, runner, watcher or Waiting())


def contents(place: Place, name: str) -> dict[str, bytes]:
    return {file: place.read(f"{name}/{file}") for file in place.files(name) if file != "run.json"}


def test_results_are_the_same_bytes_at_every_place(folder: str, tmp_path: Path) -> None:
    Place(folder).write("in/a.mcap", b"abc")
    task = task_of(f"{folder}/in/a.mcap", f"{folder}/out")
    assert do(task, tmp_path / "scratch").state == "done"
    write_results(tmp_path / "alone", 3)
    there = contents(Place(f"{folder}/out"), "a")
    assert there == {
        file.relative_to(tmp_path / "alone").as_posix(): file.read_bytes()
        for file in (tmp_path / "alone").rglob("*")
        if file.is_file() and file.name != "run.json"
    }
    run = json.loads(Place(f"{folder}/out").read("a/run.json"))
    assert run["fleet"]["state"] == "done"
    assert run["bag"] == task.recording.uri
    assert run["files"] == sorted([*there, "run.json"])


def test_an_input_of_the_same_content_is_not_surveyed_again(folder: str, tmp_path: Path) -> None:
    place = Place(folder)
    place.write("in/a.mcap", b"abc")
    do(task_of(f"{folder}/in/a.mcap", f"{folder}/out"), tmp_path / "first")
    task = task_of(f"{folder}/in/a.mcap", f"{folder}/out")
    copied = dataclasses.replace(
        task, recording=dataclasses.replace(task.recording, files={})
    )  # another time of the file
    assert do(copied, tmp_path / "second", survey_by_plan) == Outcome("a", "kept")
    place.write("in/a.mcap", b"abcd")
    assert do(task_of(f"{folder}/in/a.mcap", f"{folder}/out"), tmp_path / "third").state == "done"


@pytest.mark.parametrize("change", [{"version": "2"}, {"boq": BOQ.replace("3.0", "4.0").encode()}, {"board": b"x"}])
def test_another_version_bill_or_board_is_surveyed_again(change: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("abc")
    task = task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out")
    do(task, tmp_path / "first")
    assert do(dataclasses.replace(task, **change), tmp_path / "second").state == "done"


@pytest.mark.parametrize("lost", ["pipes.json", "colmap/images.txt"])
def test_results_that_are_not_whole_are_made_again(lost: str, tmp_path: Path) -> None:
    place = Place(str(tmp_path))
    place.write("a.mcap", b"abc")
    task = task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out")
    do(task, tmp_path / "first")
    place.write(f"out/a/{lost}", b"half")
    assert do(task, tmp_path / "second").state == "done"
    assert place.read(f"out/a/{lost}") != b"half"


def test_what_an_earlier_survey_left_and_this_one_does_not_goes(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("abc")
    (tmp_path / "out/a/pictures").mkdir(parents=True)
    (tmp_path / "out/a/pictures/old.png").write_text("")
    do(task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out"), tmp_path / "scratch")
    assert not (tmp_path / "out/a/pictures").exists()


def test_a_survey_that_is_stopped_while_it_stores_counts_for_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_text("abc")
    task = task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out")
    do(task, tmp_path / "first")
    (tmp_path / "a.mcap").write_text("abcd")
    task = task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out")

    def full(*_: Any) -> None:
        raise StorageFailure("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(storage.Place, "store", full)
        with pytest.raises(StorageFailure):
            do(task, tmp_path / "second")
    assert not (tmp_path / "out/a/run.json").exists(), "the results of another recording would count"
    assert do(task, tmp_path / "third").state == "done"


def test_a_copy_that_is_torn_is_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = Place(f"memory://{tmp_path.name}")
    place.write("a.mcap", b"abc")
    task = task_of(f"{place.uri}/a.mcap", f"{tmp_path}/out")
    monkeypatch.setattr(Place, "files", lambda *_: {"a.mcap": storage.Mark(4, "")})
    with pytest.raises(StorageFailure, match="3 of 4 bytes"):
        do(task, tmp_path / "scratch")


def test_a_recording_that_is_gone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("abc")
    task = task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out")
    (tmp_path / "a.mcap").unlink()
    outcome = do(task, tmp_path / "scratch")
    assert (outcome.state, outcome.reason) == ("refused", f"no such file or folder: {tmp_path}/a.mcap")


@pytest.mark.parametrize(("plan", "state"), [("refuse", "refused"), ("2.5", "done")])
def test_bad_input_is_an_outcome_and_no_failure(plan: str, state: str, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text(plan)
    assert do(task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out"), tmp_path / "scratch", survey_by_plan).state == state


def test_a_failure_leaves_no_results(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("fail")
    with pytest.raises(SurveyFailure, match="a node died"):
        do(task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out"), tmp_path / "scratch", survey_by_plan)
    assert not (tmp_path / "out").exists()


def test_where_nobody_waits_nothing_is_stored(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("abc")
    with pytest.raises(Unwanted):
        do(task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out"), tmp_path / "scratch", watcher=Waiting(False))
    assert not (tmp_path / "out").exists()


def test_a_reason_of_the_runner_and_its_log_are_kept(tmp_path: Path) -> None:
    def refuse(*_: Any) -> dict[str, Any]:
        raise Refused("no frames", "a log\n")

    (tmp_path / "a.mcap").write_text("abc")
    outcome = do(task_of(f"{tmp_path}/a.mcap", f"{tmp_path}/out"), tmp_path / "scratch", refuse)
    assert outcome == Outcome("a", "refused", "no frames", "a log\n")


def test_a_recording_without_earlier_results_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A huge one that cannot be surveyed costs what its replay costs to say so."""

    def refuse(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
        raise Refused("it is no recording", "")

    monkeypatch.setattr(fingerprint, "digest", lambda task, recording: pytest.fail("the recording was read"))
    (tmp_path / "a.mcap").write_bytes(b"abc")
    assert do(task_of(str(tmp_path / "a.mcap"), str(tmp_path / "out")), tmp_path / "scratch", refuse).state == "refused"


def test_a_recording_that_grows_meanwhile_is_surveyed_again(tmp_path: Path) -> None:
    bag = tmp_path / "a.mcap"

    def find_while_it_grows(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
        facts = find(task, folder, watcher)
        bag.write_bytes(b"abcdef")
        return facts

    bag.write_bytes(b"abc")
    task = task_of(str(bag), str(tmp_path / "out"))
    assert do(task, tmp_path / "first", find_while_it_grows).state == "done"
    assert do(task_of(str(bag), str(tmp_path / "out")), tmp_path / "second").state == "done"
    assert do(task_of(str(bag), str(tmp_path / "out")), tmp_path / "third").state == "kept"
