# SPDX-License-Identifier: Apache-2.0
"""Many surveys on clusters of Dask: all are accounted for, whatever dies."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed", reason="Dask is not installed: make setup FLEET=1")

import dask
import distributed

from pipeprog_bringup.fleet.recordings import Inputs, Recording
from pipeprog_bringup.fleet.scheduling import MEMORY, SLOT, RemoteCluster, local_cluster, run
from pipeprog_bringup.fleet.storage import Mark
from pipeprog_bringup.fleet.task import Outcome, Task
from pipeprog_camera.errors import InputError
from tests.unit.bringup.fleet.stand_ins import BOQ, survey_by_plan


@contextlib.contextmanager
def threads(slots: int = 2, room: int = 4000, offers: bool = True) -> Iterator[Any]:
    """A cluster of threads in this process, which starts at once."""
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=slots,
            processes=False,
            dashboard_address=None,
            resources={SLOT: slots, MEMORY: room} if offers else {},
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def tasks_of(folder: Path, plans: list[str]) -> list[Task]:
    tasks = []
    for number, plan in enumerate(plans):
        file = folder / f"r{number:03d}.mcap"
        file.write_text(plan)
        recording = Recording(file.stem, str(file), {file.name: Mark(len(plan), "")}, Inputs())
        tasks.append(Task(recording, ".yaml", BOQ.encode(), b"", str(folder / "out"), "1", 1, 1000))
    return tasks


def outcomes_of(tasks: list[Task], cluster: Any = threads, told: list[dict[str, Any]] | None = None) -> list[Outcome]:
    states = [] if told is None else told
    return list(run(tasks, cluster, survey_by_plan, states.append))


def tries(folder: Path, name: str) -> int:
    return len((folder / "out.tries" / name).read_text().split())


def test_recordings_that_fail_by_a_plan_are_all_accounted_for(tmp_path: Path) -> None:
    plans = random.Random(22).choices(["1.5", "fail once", "fail", "refuse"], [85, 5, 5, 5], k=120)
    expected = {"1.5": "done", "fail once": "done", "fail": "failed", "refuse": "refused"}
    found = {one.name: one.state for one in outcomes_of(tasks_of(tmp_path, plans))}
    assert found == {f"r{number:03d}": expected[plan] for number, plan in enumerate(plans)}
    whole = {run.parent.name for run in (tmp_path / "out").glob("*/run.json")}
    assert whole == {name for name, state in found.items() if state == "done"}
    counts = {"1.5": 1, "fail once": 2, "fail": 2, "refuse": 1}  # what cannot help is not tried twice
    assert all(tries(tmp_path, f"r{number:03d}") == counts[plan] for number, plan in enumerate(plans))


def test_states_of_the_surveys_and_their_end_are_told(tmp_path: Path) -> None:
    told: list[dict[str, Any]] = []
    (outcome,) = outcomes_of(tasks_of(tmp_path, ["fail"]), told=told)
    assert (outcome.reason, outcome.log) == ("a node died", "what the node said\n")
    assert {state["name"] for state in told} == {"r000"}
    assert [state["stage"] for state in told][:2] == ["fetching", "replay"]


def test_surveys_run_beside_each_other_as_far_as_memory_goes(tmp_path: Path) -> None:
    told: list[dict[str, Any]] = []
    tasks = [dataclasses.replace(task, memory=9999) for task in tasks_of(tmp_path, ["1"] * 4)]
    assert {one.state for one in outcomes_of(tasks, told=told)} == {"done"}
    steps = [(state["name"], state["stage"]) for state in told if state["stage"] in ("fetching", "")]
    assert [stage for _, stage in steps] == ["fetching", ""] * 4, "one after another: each takes all of the memory"
    assert all(before[0] == after[0] for before, after in zip(steps[::2], steps[1::2], strict=True))


def test_a_cluster_whose_workers_offer_no_slots_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--resources"):
        outcomes_of(tasks_of(tmp_path, ["1"]), lambda: threads(offers=False))


def test_an_address_without_a_scheduler_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeprog_bringup.fleet.scheduling._CONNECT_SECONDS", 0.2)
    with pytest.raises(InputError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers"):
        outcomes_of(tasks_of(tmp_path, ["1"]), RemoteCluster("tcp://127.0.0.1:9"))


def test_an_interruption_ends_what_runs(tmp_path: Path) -> None:
    surveys = run(tasks_of(tmp_path, ["1", "wait", "wait"]), threads, survey_by_plan, lambda _: None)
    assert next(surveys).name == "r000"
    surveys.close()  # type: ignore[attr-defined]
    assert not (tmp_path / "out" / "r001").exists()


def test_a_killed_worker_costs_time_and_a_task_that_kills_them_itself_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = ["kill once", "kill", "2", "3"]
    monkeypatch.setattr("pipeprog_bringup.fleet.scheduling._DEATHS_ALONE", 2)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        found = {one.name: one for one in outcomes_of(tasks_of(tmp_path, plans), lambda: local_cluster(2, 1))}
    assert {name: one.state for name, one in found.items()} == {
        **dict.fromkeys(("r000", "r002", "r003"), "done"),
        "r001": "failed",
    }
    assert "its worker died 2 times while no other survey ran" in found["r001"].reason
    assert found["r001"].log == "it works\n"
    killed = {int(pid) for pid in (tmp_path / "out.tries" / "r001").read_text().split()}
    for pid in killed:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, signal.SIG_DFL)


class Ended:
    """A future that has ended."""

    def __init__(self, name: str, is_dead: bool) -> None:
        self._name, self.status = name, "error" if is_dead else "finished"

    def add_done_callback(self, call: Any) -> None:
        call(self)

    def exception(self) -> Exception:
        return distributed.KilledWorker(self._name, None, 0)

    def result(self) -> Outcome:
        return Outcome(self._name, "done")

    def release(self) -> None:
        pass


class Cluster:
    """A cluster as a session sees it, whose futures end at once with the death of the worker.

    `deaths` says how often for each recording; after that its survey is done.
    """

    cluster, status = None, "running"

    def __init__(self, deaths: dict[str, int]) -> None:
        self._deaths = deaths
        self.ran: list[str] = []

    def subscribe_topic(self, *_: Any) -> None:
        pass

    def cancel(self, _: Any) -> None:
        pass

    def scheduler_info(self) -> dict[str, Any]:
        return {"workers": {"tcp://one": {"resources": {SLOT: 1}}}}

    def submit(self, _: Any, task: Task, *__: Any, **___: Any) -> Ended:
        self.ran.append(task.name)
        self._deaths[task.name] -= 1
        return Ended(task.name, self._deaths[task.name] >= 0)


def test_only_deaths_of_a_worker_that_ran_it_alone_are_held_against_a_recording(tmp_path: Path) -> None:
    tasks = tasks_of(tmp_path, ["1"] * 3)
    client: Any = Cluster({"r000": 10, "r001": 11, "r002": 0})
    outcomes = list(run(tasks, lambda: contextlib.nullcontext(client), survey_by_plan, lambda _: None))
    assert {one.name: one.state for one in outcomes} == {"r000": "done", "r001": "failed", "r002": "done"}
    assert client.ran[:3] == ["r000", "r001", "r002"]
    assert client.ran[3:7] == ["r000", "r001"] * 2, "suspects take turns"
