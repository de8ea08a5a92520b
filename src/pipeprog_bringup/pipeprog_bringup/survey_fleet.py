# SPDX-License-Identifier: Apache-2.0
"""`pipeprog fleet`: many recordings, each surveyed as `pipeprog replay` does it, on the workers of a Dask cluster."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

from dask.system import CPU_COUNT

from pipeprog_bringup.fleet import fingerprint
from pipeprog_bringup.fleet.fleet_file import is_fleet_file, read_fleet_file
from pipeprog_bringup.fleet.memory import foreseen
from pipeprog_bringup.fleet.recordings import Inputs, Recording, listed, require_distinct
from pipeprog_bringup.fleet.replay_process import replay_and_report
from pipeprog_bringup.fleet.scheduling import RemoteCluster, local_cluster, run
from pipeprog_bringup.fleet.storage import Place, StorageFailure
from pipeprog_bringup.fleet.summary import PAGE, Row, rows_of, write_summary
from pipeprog_bringup.fleet.survey import RUN, record
from pipeprog_bringup.fleet.task import Outcome, Runner, Task
from pipeprog_bringup.results.result_files import package_version
from pipeprog_bringup.results.setting_overrides import effective
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_XLSX
from pipeprog_detect.product.boq import load_boq
from pipeprog_sfm.boards.board_file import load_board_file


@dataclasses.dataclass(frozen=True)
class Request:
    """What to survey: addresses of recordings, bill and boards; where results go, and on which cluster."""

    recordings: Sequence[str]
    out: str
    boq: str = ""
    board: str = ""
    overrides: Sequence[str] = ()
    scheduler: str = ""
    cores: int = 2


class Display(Protocol):
    """Where the surveys stand, for people."""

    def begin(self, total: int, kept: int) -> None:
        """How many recordings there are, and of how many the results are there."""

    def tell(self, state: dict[str, Any]) -> None:
        """Where one survey stands."""

    def end(self, outcome: Outcome) -> None:
        """What became of one."""


@dataclasses.dataclass(frozen=True)
class Fleet:
    """A row for each recording, and the address of the page about them."""

    rows: list[Row]
    page: str


def survey_fleet(request: Request, display: Display, runner: Runner = replay_and_report) -> Fleet:
    """Survey what has no results yet or has changed, and write the summary.

    Raises InputError for what the user can mend; what is wrong with a single recording stands in its row.
    """
    try:
        place = Place(request.out)
        recordings = _recordings(request)
        tasks = _tasks(request, recordings)
        outcomes, waiting = _split(place, tasks)
        display.begin(len(tasks), len(outcomes))
        try:
            for outcome in run(waiting, _connect(request), runner, display.tell) if waiting else ():
                if outcome.state in ("refused", "failed"):
                    record(place, next(task for task in waiting if task.name == outcome.name), outcome)
                outcomes[outcome.name] = outcome
                display.end(outcome)
        except BaseException:
            if not request.scheduler:  # the workers of a cluster elsewhere bring to an end what they are storing
                _remove_halves(place, [task.name for task in waiting if task.name not in outcomes])
            raise
        rows = rows_of(place, recordings, outcomes)
        write_summary(place, rows)
    except StorageFailure as error:
        raise InputError(f"{error}: check the address and the connection, then run the command again") from None
    return Fleet(rows, f"{request.out.rstrip('/')}/{PAGE}")


def _recordings(request: Request) -> list[Recording]:
    """The recordings of all arguments; raises InputError where there are none, or two of one name."""
    effective(request.overrides)
    inputs = Inputs(request.boq, request.board, tuple(request.overrides))
    found = [
        one
        for address in request.recordings
        for one in (read_fleet_file(Path(address), inputs) if is_fleet_file(address) else listed(address, inputs))
    ]
    require_distinct(found)
    return found


def _tasks(request: Request, recordings: Sequence[Recording]) -> list[Task]:
    contents: dict[str, bytes] = {"": b""}
    version = package_version("pipeprog") or "unknown"
    for one in recordings:
        if not one.inputs.boq:
            raise InputError(f"{one.uri} has no bill of quantities: give --boq, or boq in the fleet.yaml")
        for address, load in ((one.inputs.boq, load_boq), (one.inputs.board, load_board_file)):
            if address not in contents:
                contents[address] = _content(address, load)
    out = request.out if "://" in request.out else str(Path(request.out).resolve())
    return [
        Task(
            recording=one,
            boq_kind=PurePosixPath(one.inputs.boq).suffix,
            boq=contents[one.inputs.boq],
            board=contents[one.inputs.board],
            out=out,
            version=version,
            cores=request.cores,
            memory=foreseen(one.size, None),
        )
        for one in recordings
    ]


def _content(address: str, load: Callable[[Path], object]) -> bytes:
    """A bill or board file, once it has been read without an error."""
    place = Place(address)
    if place.is_local:
        load(Path(address))
        return place.read()
    size = next(iter(place.files().values())).size if place.is_file() else 0
    if size > MAX_XLSX:
        raise InputError(f"{address} has {size} bytes, which no such file has: check the address")
    content = place.read()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, address.rpartition("/")[2])
        file.write_bytes(content)
        try:
            load(file)
        except InputError as error:
            raise InputError(str(error).replace(str(file), address)) from None
    return content


def _split(place: Place, tasks: Sequence[Task]) -> tuple[dict[str, Outcome], list[Task]]:
    """Outcomes of the tasks whose results are there, whole and of the same input; and the others.

    Of a recording that was refused the reason is a result; one that failed is tried again.
    """
    there = place.files()
    names = [f"{task.name}/{RUN}" for task in tasks if f"{task.name}/{RUN}" in there]
    runs = {name: fingerprint.parsed(content) for name, content in place.read_all(names).items()}
    own: dict[str, dict[str, Any]] = {}
    for name, mark in there.items():
        folder, _, file = name.partition("/")
        own.setdefault(folder, {})[file] = mark
    outcomes, waiting = {}, []
    for task in tasks:
        run_json = runs.get(f"{task.name}/{RUN}") or {}
        entry = run_json.get("fleet", {})
        is_same = entry.get("mark") == fingerprint.mark(task) and fingerprint.is_whole(run_json, own[task.name])
        if is_same and entry.get("state") == "done":
            outcomes[task.name] = Outcome(task.name, "kept")
        elif is_same and entry.get("state") == "refused":
            outcomes[task.name] = Outcome(task.name, "refused", str(entry.get("reason", "")))
        else:
            peak = entry.get("peak_mb")
            known = peak if isinstance(peak, int) else None
            waiting.append(dataclasses.replace(task, memory=foreseen(task.recording.size, known)))
    return outcomes, waiting


def _connect(request: Request) -> Any:
    if request.scheduler:
        return RemoteCluster(request.scheduler)
    return lambda: local_cluster(CPU_COUNT, request.cores)


def _remove_halves(place: Place, names: Sequence[str]) -> None:
    """Remove what surveys that were stopped had stored without their run.json."""
    for name in names:
        files = place.files(name)
        if files and RUN not in files:
            place.remove(f"{name}/{file}" for file in files)
