# SPDX-License-Identifier: Apache-2.0
"""Fleets of recordings: what two workers save, what dies and is not lost, and what a scheduler holds.

    .venv/bin/python -m benchmarks.fleet simulated                    # 500 recordings of 1 s that fail by a plan
    .venv/bin/python -m benchmarks.fleet throughput [--recordings 8]  # one after another, 1 and 2 at once
    .venv/bin/python -m benchmarks.fleet kills [--stand-in]           # workers and schedulers are killed

Writes results/fleet_NAME.json. `throughput` and `kills` take the first frames of the demo recording (--frames);
`kills --stand-in` takes surveys of 2 s in place of replays. Needs `make setup FLEET=1`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
from mcap.reader import make_reader

from benchmarks.markdown import measured_rows
from benchmarks.recordings import DEMO, ROOT
from benchmarks.survey import COMMAND, RESULTS, commit
from pipeprog_bringup.fleet.recordings import Inputs, listed
from pipeprog_bringup.fleet.replay_process import replay_and_report
from pipeprog_bringup.fleet.scheduling import local_cluster, run
from pipeprog_bringup.fleet.task import Outcome, Refused, SurveyFailure, Task, Unwanted, Watcher
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.survey_fleet import Request, survey_fleet
from tests.unit.bringup.fleet.stand_ins import write_results

HOME = ROOT / "out" / "fleet"
STAND_IN_SECONDS = 2.0
# Files of a survey that hold times and paths beside its results.
TITLES = {
    "simulated": "Recordings whose surveys take a second and fail by a plan",
    "throughput": "One after another with the whole machine; as a fleet of one and of two, each with half of it",
    "kills": "Workers and schedulers killed during replays",
    "kills_stand_in": "Workers and schedulers killed during surveys of two seconds",
}
NOT_COMPARED = {"run.json", "config.yaml", "out.mcap", "report.html"}


class Quiet:
    """A display that keeps nothing."""

    def begin(self, total: int, kept: int) -> None:
        """How many recordings there are."""

    def tell(self, state: dict[str, Any]) -> None:
        """Where a survey stands."""

    def end(self, outcome: Outcome) -> None:
        """What became of one."""
        print(f"  {outcome.name}: {outcome.state} {outcome.reason}", flush=True)


def cut(frames: int, target: Path) -> Path:
    """The demo recording's first frames, with what lies between them."""
    with DEMO.bag.open("rb") as source, target.open("wb") as stream, BagWriter(stream) as writer:
        images = 0
        for schema, channel, message in make_reader(source).iter_messages():
            images += schema is not None and schema.name == "sensor_msgs/msg/CompressedImage"
            if images > frames:
                break
            writer.write(channel.topic, schema.name if schema else "", message.data, message.log_time)
    return target


def stand_in(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
    """A survey of 2 s whose results are the recording's bytes."""
    (recording,) = (folder / "recording").iterdir()
    deadline = time.monotonic() + STAND_IN_SECONDS
    while time.monotonic() < deadline:
        watcher.tell({"stage": "replay"})
        if not watcher.is_wanted():
            raise Unwanted
        time.sleep(0.1)
    write_results(folder / "results", 1.0)
    shutil.copy(recording, folder / "results" / "cloud.ply")
    return {"peak_mb": 0}


def planned(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
    """A survey of 1 s that ends as its recording says."""
    (recording,) = (folder / "recording").iterdir()
    plan = recording.read_text().split("\n")[0]
    time.sleep(1.0)
    tried = Path(f"{task.out}.tried") / task.name
    is_first = not tried.exists()
    tried.touch()
    if plan == "refuse":
        raise Refused("it is no recording")
    if plan == "fail" or (plan == "fail once" and is_first):
        raise SurveyFailure("a node died")
    (folder / "results").mkdir()
    (folder / "results" / "run.json").write_text("{}")
    return {"peak_mb": 0}


def simulated(recordings: int) -> dict[str, Any]:
    """`recordings` of them on a local cluster of 16 slots: what became of them, the memory of scheduler and client."""
    folder = _empty(HOME / "simulated")
    (folder / "in").mkdir()
    (folder / "out.tried").mkdir()
    plans = random.Random(22).choices(["succeed", "fail once", "fail", "refuse"], [85, 5, 5, 5], k=recordings)
    for number, plan in enumerate(plans):
        (folder / "in" / f"r{number:03d}.mcap").write_text(f"{plan}\n{number}")
    tasks = [
        Task(one, ".yaml", b"", b"", str(folder / "out"), "1", 1, 1) for one in listed(str(folder / "in"), Inputs())
    ]
    before, started = _resident(), time.monotonic()
    states = {one.name: one.state for one in run(tasks, lambda: local_cluster(16, 1), planned, lambda _: None)}
    expected = {"succeed": "done", "fail once": "done", "fail": "failed", "refuse": "refused"}
    right = sum(states.get(f"r{number:03d}") == expected[plan] for number, plan in enumerate(plans))
    whole = {file.parent.name for file in (folder / "out").glob("*/run.json")}
    return {
        "recordings": recordings,
        "slots": 16,
        "as_planned": right,
        "states": {state: list(states.values()).count(state) for state in sorted(set(states.values()))},
        "results_whole": len(whole),
        "results_of_others": len(whole - {name for name, state in states.items() if state == "done"}),
        "wall_s": round(time.monotonic() - started, 1),
        "scheduler_mib_before": before,
        "scheduler_mib_peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10,
    }


def throughput(recordings: int, frames: int) -> dict[str, Any]:
    """`recordings` copies one after another; then as fleets of 1 and of 2 at once, with half of the cores each."""
    folder = _recordings(HOME / "throughput", recordings, frames)
    options: list[str | Path] = ["--boq", str(DEMO.beside("boq.yaml")), "--board", str(DEMO.beside("board.yaml"))]
    started = time.monotonic()
    for bag in sorted((folder / "in").iterdir()):
        out = folder / "alone" / bag.stem
        subprocess.run([COMMAND, "replay", bag, *options, "--out", out], check=True, stderr=subprocess.DEVNULL)
        subprocess.run([COMMAND, "report", out, "--out", out / "report.html"], check=True, stderr=subprocess.DEVNULL)
    seconds = {"one_after_another": round(time.monotonic() - started, 1)}
    cores = sorted(os.sched_getaffinity(0))
    each = max(1, len(cores) // 2)
    facts: dict[str, Any] = {}
    for workers in (1, 2):
        out = folder / f"out{workers}"
        command = [COMMAND, "fleet", folder / "in", *options, "--out", out, "--cores", str(each)]
        allowed = ["taskset", "-c", ",".join(map(str, cores[: workers * each]))]  # which is how many run at once
        started = time.monotonic()
        subprocess.run([*allowed, *command], check=True)
        seconds[f"fleet_of_{workers}"] = round(time.monotonic() - started, 1)
        facts[f"fleet_of_{workers}"] = _means(out)
    started = time.monotonic()
    subprocess.run(command, check=True)
    again = time.monotonic() - started
    return {
        "recordings": recordings,
        "frames": frames,
        "cores": len(cores),
        "cores_of_each_survey_of_a_fleet": each,
        "load_at_the_end": round(os.getloadavg()[0], 2),
        "seconds": seconds,
        "share_of_one_after_another": round(seconds["fleet_of_2"] / seconds["one_after_another"], 3),
        "share_of_a_fleet_of_1": round(seconds["fleet_of_2"] / seconds["fleet_of_1"], 3),
        "again_s_a_recording": round(again / recordings, 3),
        "same_bytes": _compare(folder / "alone", [folder / "out1", folder / "out2"]),
        "means": facts,
    }


def kills(recordings: int, frames: int, workers: int, schedulers: int, is_stand_in: bool) -> dict[str, Any]:
    """A fleet whose worker is killed at random moments, then one whose command, with its scheduler, is killed."""
    runner = "stand_in" if is_stand_in else "replay"
    folder = _recordings(HOME / f"kills_{runner}", recordings, frames)
    moments = random.Random(7)
    pause = STAND_IN_SECONDS if is_stand_in else 0.0
    with _private_scratch(folder) as scratch:
        started = time.monotonic()
        _finish(_fleet(folder, "alone", runner, 1))
        mean = (time.monotonic() - started) / recordings
        killed = _kill_workers(folder, runner, workers, moments, pause or mean)
        killed_schedulers = _kill_schedulers(folder, runner, schedulers, moments, pause or mean)
        left = sorted(path.name for path in scratch.iterdir())
    names = sorted(path.stem for path in (folder / "in").iterdir())
    return {
        "runner": f"surveys of {STAND_IN_SECONDS} s" if is_stand_in else f"pipeprog replay of {frames} frames",
        "recordings": recordings,
        "mean_s_of_a_recording_alone": round(mean, 1),
        "workers_killed": killed,
        "schedulers_killed": killed_schedulers,
        "same_bytes": _compare(folder / "alone", [folder / "workers", folder / "schedulers"]),
        "whole_results": {
            name: sorted(file.parent.name for file in (folder / name).glob("*/run.json")) == names
            for name in ("workers", "schedulers")
        },
        "scratch_left": left,
        "processes_left": [" ".join(one.cmdline())[:200] for one in _processes(folder)],
    }


def _kill_workers(folder: Path, runner: str, count: int, moments: random.Random, mean: float) -> int:
    """Kill the Dask worker of one fleet after another until `count` have died; number killed."""
    killed = 0
    while killed < count:
        shutil.rmtree(folder / "workers", ignore_errors=True)
        fleet = _fleet(folder, "workers", runner, 2)
        while fleet.poll() is None and killed < count:
            _wait_for_survey(fleet, folder / "tmp")
            with contextlib.suppress(subprocess.TimeoutExpired):
                fleet.wait(moments.uniform(0.0, 2.0) * mean)
            for worker in _dask_workers(fleet.pid):
                worker.kill()
                worker.wait()
                killed += 1
                print(f"worker killed ({killed})", flush=True)
        _finish(fleet)
    return killed


def _kill_schedulers(folder: Path, runner: str, count: int, moments: random.Random, mean: float) -> int:
    """Kill the command, which holds the scheduler, and start it again, until it has been killed `count` times."""
    killed = 0
    while True:
        fleet = _fleet(folder, "schedulers", runner, 2)
        if killed < count:
            _wait_for_survey(fleet, folder / "tmp")
            with contextlib.suppress(subprocess.TimeoutExpired):
                fleet.wait(moments.uniform(0.0, 1.5) * mean)
            if fleet.poll() is not None:
                shutil.rmtree(folder / "schedulers")
                continue
            fleet.kill()
            fleet.wait()
            killed += 1
            print(f"scheduler killed ({killed})", flush=True)
            continue
        _finish(fleet)
        return killed


def _fleet(folder: Path, out: str, runner: str, workers: int) -> subprocess.Popen[bytes]:
    cores = max(1, (os.cpu_count() or 1) // workers)
    command = [sys.executable, "-m", "benchmarks.fleet", "run", str(folder), out, runner, str(cores)]
    return subprocess.Popen(command, cwd=ROOT)


def _finish(fleet: subprocess.Popen[bytes]) -> None:
    if fleet.wait():
        raise RuntimeError(f"a fleet ended with {fleet.returncode}")


def _wait_for_survey(fleet: subprocess.Popen[bytes], scratch: Path) -> None:
    """Until a survey runs, or the fleet has ended."""
    while fleet.poll() is None and not any(scratch.glob("pipeprog-fleet-*/dask-scratch-space/worker-*/survey-*")):
        time.sleep(0.05)


def _dask_workers(pid: int) -> list[psutil.Process]:
    """The workers of a fleet's command: children that multiprocessing has started, with a survey or ready for one."""
    with contextlib.suppress(psutil.Error):
        return [one for one in psutil.Process(pid).children() if "spawn_main" in " ".join(one.cmdline())]
    return []


def _processes(folder: Path) -> list[psutil.Process]:
    """Processes that work in a folder's scratch, a few seconds after all have been asked to end."""
    psutil.wait_procs([], timeout=0)
    deadline = time.monotonic() + 10
    while found := [one for one in psutil.process_iter() if _works_in(one, folder / "tmp")]:
        if time.monotonic() > deadline:
            break
        time.sleep(0.2)
    return found


def _works_in(process: psutil.Process, folder: Path) -> bool:
    try:
        return process.environ().get("TMPDIR", "").startswith(str(folder)) and process.pid != os.getpid()
    except psutil.Error:
        return False


@contextlib.contextmanager
def _private_scratch(folder: Path) -> Iterator[Path]:
    """Temporary files of this process and its children in a folder of their own."""
    scratch = folder / "tmp"
    scratch.mkdir()
    before = os.environ.get("TMPDIR")
    os.environ["TMPDIR"] = tempfile.tempdir = str(scratch)
    try:
        yield scratch
    finally:
        tempfile.tempdir = None
        os.environ.pop("TMPDIR")
        if before is not None:
            os.environ["TMPDIR"] = before


def _recordings(folder: Path, count: int, frames: int) -> Path:
    _empty(folder)
    (folder / "in").mkdir()
    bag = cut(frames, folder / "cut.mcap")
    for number in range(count):
        shutil.copy(bag, folder / "in" / f"r{number}.mcap")
    return folder


def _empty(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _compare(alone: Path, others: Sequence[Path]) -> dict[str, Any]:
    """Files of results that were compared with those of the same recordings alone, and those that differ."""
    names = [file.relative_to(alone) for file in sorted(alone.glob("*/**/*")) if file.is_file()]
    names = [name for name in names if name.name not in NOT_COMPARED]
    differ = [
        f"{other.name}/{name}"
        for other in others
        for name in names
        if not (other / name).is_file() or (other / name).read_bytes() != (alone / name).read_bytes()
    ]
    return {"files_compared": len(names) * len(others), "differ": differ}


def _means(out: Path) -> dict[str, float]:
    """Means of what the surveys of a fleet took."""
    entries = [json.loads(file.read_text())["fleet"] for file in out.glob("*/run.json")]
    keys = ("fetch_s", "replay_s", "report_s", "store_s", "peak_mb")
    return {key: round(sum(entry[key] for entry in entries) / len(entries), 3) for key in keys}


def _resident() -> int:
    return psutil.Process().memory_info().rss >> 20


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    names = parser.add_subparsers(dest="name", required=True)
    one = names.add_parser("simulated")
    one.add_argument("--recordings", type=int, default=500)
    for name, recordings in (("throughput", 8), ("kills", 4)):
        one = names.add_parser(name)
        one.add_argument("--recordings", type=int, default=recordings)
        one.add_argument("--frames", type=int, default=20, help="of the demo recording; 20 give 14 keyframes")
    one.add_argument("--workers", type=int, default=20, help="to kill")
    one.add_argument("--schedulers", type=int, default=5, help="to kill")
    one.add_argument("--stand-in", action="store_true")
    one = names.add_parser("run", help="one fleet, as the benchmark itself calls it")
    one.add_argument("arguments", nargs=4)
    arguments = vars(parser.parse_args())
    name = arguments.pop("name")
    if name == "run":
        folder, out, runner, cores = arguments["arguments"]
        boq, board = (str(DEMO.beside(f"{kind}.yaml")) for kind in ("boq", "board"))
        request = Request([f"{folder}/in"], f"{folder}/{out}", boq, board, cores=int(cores))
        fleet = survey_fleet(request, Quiet(), stand_in if runner == "stand_in" else replay_and_report)
        sys.exit(any(row.survey is None for row in fleet.rows))
    if name == "kills":
        arguments["is_stand_in"] = arguments.pop("stand_in")
        name += "_stand_in" * arguments["is_stand_in"]
    measures: dict[str, Callable[..., dict[str, Any]]] = {"simulated": simulated, "throughput": throughput}
    given = " ".join(f"--{key} {value}" for key, value in arguments.items() if key != "is_stand_in")
    content = {
        "title": TITLES[name],
        "command": f"python -m benchmarks.fleet {name.replace('_stand_in', ' --stand-in')} {given}",
        "commit": commit(),
        "rows": measured_rows(measures.get(name, kills)(**arguments)),
    }
    (RESULTS / f"fleet_{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    main()
