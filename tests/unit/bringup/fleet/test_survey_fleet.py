# SPDX-License-Identifier: Apache-2.0
"""The command from its request to its page, with a runner that answers at once on a cluster in this process."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed", reason="Dask is not installed: make setup FLEET=1")

import openpyxl

from pipeprog_bringup import survey_fleet as module
from pipeprog_bringup.fleet.storage import Place
from pipeprog_bringup.fleet.task import Outcome
from pipeprog_bringup.survey_fleet import Fleet, Request, survey_fleet
from pipeprog_camera.errors import InputError
from tests.unit.bringup.fleet.stand_ins import BOQ, survey_by_plan
from tests.unit.bringup.fleet.test_scheduling import threads


class Watching:
    """Keeps what a display would show."""

    def __init__(self) -> None:
        self.counts = (0, 0)
        self.ended: dict[str, Outcome] = {}

    def begin(self, total: int, kept: int) -> None:
        self.counts = (total, kept)

    def tell(self, state: dict[str, Any]) -> None:
        pass

    def end(self, outcome: Outcome) -> None:
        self.ended[outcome.name] = outcome


@pytest.fixture(autouse=True)
def quick_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def cluster(cores: int, cores_each: int) -> Iterator[Any]:
        with threads() as client:
            yield client

    monkeypatch.setattr(module, "local_cluster", cluster)


def night(folder: Path, **plans: str) -> Request:
    """Recordings of a night by name and plan, each a file of its own."""
    (folder / "night").mkdir(exist_ok=True)
    (folder / "boq.yaml").write_text(BOQ)
    for name, plan in plans.items():
        (folder / "night" / f"{name}.mcap").write_text(f"{plan}\n{name}")
    return Request([str(folder / "night")], str(folder / "out"), boq=str(folder / "boq.yaml"))


def do(request: Request) -> tuple[Fleet, Watching]:
    watching = Watching()
    return survey_fleet(request, watching, survey_by_plan), watching


def states(fleet: Fleet) -> dict[str, str]:
    return {row.recording.name: row.state for row in fleet.rows}


def test_bad_recordings_among_good_ones_have_their_reason(tmp_path: Path) -> None:
    fleet, watching = do(night(tmp_path, a="1.5", b="refuse", c="fail", d="2"))
    assert states(fleet) == {"a": "done", "b": "refused", "c": "failed", "d": "done"}
    assert {row.recording.name: row.reason for row in fleet.rows if row.reason} == {
        "b": "it is no recording",
        "c": "a node died",
    }
    assert watching.counts == (4, 0)
    assert watching.ended["c"].state == "failed"
    assert (tmp_path / "out/c/replay.log").read_text() == "what the node said\n"
    assert json.loads((tmp_path / "out/b/run.json").read_text())["fleet"]["reason"] == "it is no recording"


def test_again_with_nothing_changed_nothing_is_computed(tmp_path: Path) -> None:
    request = night(tmp_path, a="1.5", b="refuse", c="2")
    do(request)
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").glob("*/*")}
    started = time.monotonic()
    fleet, watching = do(request)
    assert time.monotonic() - started < 3 * 2.0
    assert states(fleet) == {"a": "kept", "b": "refused", "c": "kept"}
    assert watching.counts == (3, 3)
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").glob("*/*")} == before
    assert all(len((tmp_path / "out.tries" / name).read_text().split()) == 1 for name in "abc")


def test_what_has_changed_failed_or_is_new_is_surveyed(tmp_path: Path) -> None:
    do(night(tmp_path, a="1.5", b="2", c="fail"))
    request = night(tmp_path, b="2.5", d="3")
    fleet, watching = do(request)
    assert states(fleet) == {"a": "kept", "b": "done", "c": "failed", "d": "done"}
    assert watching.counts == (4, 1)
    (tmp_path / "boq.yaml").write_text(BOQ.replace("3.0", "4.0"))
    assert states(do(request)[0]) == {"a": "done", "b": "done", "c": "failed", "d": "done"}


def test_a_recording_that_is_copied_again_keeps_its_results(tmp_path: Path) -> None:
    request = night(tmp_path, a="1.5")
    do(request)
    os.utime(tmp_path / "night/a.mcap", (1e9, 1e9))
    assert states(do(request)[0]) == {"a": "kept"}
    assert len((tmp_path / "out.tries/a").read_text().split()) == 1
    assert do(request)[1].counts == (1, 1), "its new time is remembered"


def test_a_table_a_workbook_and_a_page_tell_of_all(tmp_path: Path) -> None:
    fleet, _ = do(night(tmp_path, a="1.5", b="refuse"))
    rows = list(csv.DictReader((tmp_path / "out/fleet.csv").open(newline="")))
    assert [row["recording"] for row in rows] == ["a", "b"]
    assert (rows[0]["state"], rows[0]["DN65 installed_m"], rows[0]["report"]) == ("done", "1.5", "a/report.html")
    assert rows[0]["warnings"] == "the tail is torn; 1 of 9 keyframes have no place in the map"
    assert (rows[1]["state"], rows[1]["reason"]) == ("refused", "it is no recording")
    book = openpyxl.load_workbook(io.BytesIO((tmp_path / "out/fleet.xlsx").read_bytes()))
    cells = [[cell.value for cell in row] for row in book["Recordings"].iter_rows()]
    assert cells[1][cells[0].index("DN65 installed_m")] == 1.5
    page = (tmp_path / "out/index.html").read_text()
    assert fleet.page == f"{tmp_path}/out/index.html"
    assert "2 recordings: 1 surveyed, 1 refused" in page
    assert '<a href="a/report.html">' in page
    assert "it is no recording" in page


def test_names_and_reasons_are_shown_as_they_are(tmp_path: Path) -> None:
    request = night(tmp_path, a="1")
    (tmp_path / "boq.yaml").write_text(BOQ.replace("DN65", "'=<b>DN65'"))
    (tmp_path / "night/=1+1.mcap").write_text("refuse")
    do(request)
    assert "_1+1,refused" in (tmp_path / "out/fleet.csv").read_text()
    assert "<b>DN65" not in (tmp_path / "out/index.html").read_text()


def test_recordings_that_share_a_frame_are_shown_over_time(tmp_path: Path) -> None:
    night(tmp_path, monday="1", tuesday="2", elsewhere="2.5")
    (tmp_path / "fleet.yaml").write_text(
        "boq: boq.yaml\nrecordings:\n  - night/monday.mcap\n  - night/elsewhere.mcap\n"
        "  - {path: night/tuesday.mcap, reference: monday}\n"
    )
    do(Request([str(tmp_path / "fleet.yaml")], str(tmp_path / "out")))
    page = (tmp_path / "out/index.html").read_text()
    assert "monday over time" in page
    assert "elsewhere over time" not in page
    book = openpyxl.load_workbook(io.BytesIO((tmp_path / "out/fleet.xlsx").read_bytes()))
    assert [[cell.value for cell in row][1:5:3] for row in book["Sites"].iter_rows(min_row=2)] == [
        ["monday", 1],
        ["tuesday", 2],
    ]


def test_a_fleet_of_object_storage(s3_folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = Place(s3_folder)
    place.write("night/a.mcap", b"1.5")
    place.write("night/b.mcap", b"refuse")
    place.write("plans/boq.yaml", BOQ.encode())
    request = Request([f"{s3_folder}/night/*.mcap"], f"{s3_folder}/out", boq=f"{s3_folder}/plans/boq.yaml")
    monkeypatch.chdir(tmp_path)  # where the stand-in counts its tries
    assert states(do(request)[0]) == {"a": "done", "b": "refused"}
    assert states(do(request)[0]) == {"a": "kept", "b": "refused"}
    assert sorted(Place(f"{s3_folder}/out").files())[-3:] == ["fleet.csv", "fleet.xlsx", "index.html"]


def test_an_interruption_leaves_no_half_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    request = night(tmp_path, a="1", b="2")

    def stopped(*_: Any) -> Iterator[Outcome]:
        (tmp_path / "out/a").mkdir(parents=True)
        (tmp_path / "out/a/pipes.json").write_text("half")
        raise KeyboardInterrupt
        yield

    with monkeypatch.context() as patch:
        patch.setattr(module, "run", stopped)
        with pytest.raises(KeyboardInterrupt):
            do(request)
    assert not (tmp_path / "out/a").exists()
    assert states(do(request)[0]) == {"a": "done", "b": "done"}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"boq": ""}, "has no bill of quantities: give --boq"),
        ({"boq": "none.yaml"}, "none.yaml"),
        ({"overrides": ["sfm.sed=1"]}, "sfm.sed=1: unknown"),
        ({"recordings": ["none.mcap"]}, "none.mcap: holds no recording"),
        ({"out": "carrier-pigeon://loft"}, "no storage can be reached"),
    ],
)
def test_a_request_that_cannot_be_done_starts_nothing(change: dict[str, Any], says: str, tmp_path: Path) -> None:
    request = night(tmp_path, a="1")
    with pytest.raises(InputError, match=says):
        do(Request(**{**vars(request), **change}))
    assert not (tmp_path / "out").exists()
