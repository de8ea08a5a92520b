# SPDX-License-Identifier: Apache-2.0
"""One recording through the node graph as a user would send it, scored against its truth: a JSON file with its command.

    .venv/bin/python -m benchmarks.survey [demo] [lab:SEED[:OPTION...]] [field:SEED[:OPTION...]] [BAG.mcap] [--set ...]

A recording that has its JSON file in results/ already is left out; remove the file to measure it again.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from benchmarks.recordings import ROOT, Recording, made, named
from pipeprog_bringup.results.scoring import score_files

RESULTS = Path(__file__).parent / "results"
RUNS = ROOT / "out" / "surveys"
COMMAND = Path(sys.executable).with_name("pipeprog")
FAILED = 1  # exit status of a replay that says why it cannot go on


def survey(
    recording: Recording, overrides: Sequence[str] = (), name: str = "", results: Path = RESULTS
) -> dict[str, Any]:
    """The figures of one replay, from results/ where they are known, measured otherwise.

    Args:
        recording: what to replay.
        overrides: settings as for `--set`.
        name: of the JSON file; the recording's name where empty.
        results: folder of the JSON files.
    """
    kept = results / f"survey_{name or recording.name}.json"
    if not kept.exists():
        results.mkdir(parents=True, exist_ok=True)
        figures = measure(made(recording), overrides, RUNS / (name or recording.name))
        _write(kept, figures)
    known: dict[str, Any] = json.loads(kept.read_text())
    return known


def attempt(recording: Recording, overrides: Sequence[str] = (), name: str = "") -> dict[str, Any]:
    """As `survey`, kept in out/surveys; a replay that ends with an error is a result as well.

    Its figures then hold `failed`, the replay's last words, in place of a score. What the replay shows while it works
    goes to NAME.log beside its folder.
    """
    name = name or recording.name
    kept = RUNS / f"survey_{name}.json"
    if not kept.exists():
        RUNS.mkdir(parents=True, exist_ok=True)
        made(recording)
        log = RUNS / f"{name}.log"
        try:
            with log.open("w") as stream:
                figures = measure(recording, overrides, RUNS / name, stream)
        except subprocess.CalledProcessError as error:
            if error.returncode != FAILED:  # interrupted or killed: nothing is known
                raise
            words = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
            figures = {"commit": commit(), "failed": words[-1] if words else ""}
        _write(kept, figures)
    known: dict[str, Any] = json.loads(kept.read_text())
    return known


def _write(path: Path, figures: dict[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(figures, indent=1) + "\n")
    part.replace(path)


def measure(recording: Recording, overrides: Sequence[str], out: Path, log: IO[str] | None = None) -> dict[str, Any]:
    """Replay into `out` and score; raises CalledProcessError where the replay fails."""
    files = {kind: str(recording.beside(f"{kind}.yaml")) for kind in ("boq", "board")}
    settings = [argument for text in overrides for argument in ("--set", text)]
    options = ["--boq", files["boq"], "--board", files["board"], "--out", str(out), "--force", *settings]
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([COMMAND, "replay", str(recording.bag), *options], check=True, stdout=log, stderr=log)
    wall, after = time.monotonic() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    run = json.loads((out / "run.json").read_text())
    pipes = json.loads((out / "pipes.json").read_text())
    return {
        "made_by": recording.made_by,
        "command": _relative(f"pipeprog replay {recording.bag} {' '.join(options)}"),
        "commit": commit(),
        "cpus": os.cpu_count(),
        "wall_s": round(wall, 1),
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "largest_process_mib": after.ru_maxrss // 1024,
        **{key: run[key] for key in ("frames_in_bag", "frames_considered", "keyframes", "registered", "timings_s")},
        "versions": run["versions"],
        "scale": pipes["scale"],
        "radius_sigmas": {pipe["id"]: pipe["radius_sigma"] for pipe in pipes["pipes"]},
        "score": score_files(out / "pipes.json", recording.beside("truth.json")),
    }


def _relative(text: str) -> str:
    return text.replace(f"{ROOT}{os.sep}", "")


def commit() -> str:
    """The commit measured; a trailing + marks changes that are not committed."""
    arguments = ["git", "describe", "--always", "--dirty=+", "--exclude", "*"]
    return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def score_figures(score: dict[str, Any]) -> dict[str, Any]:
    """The figures of a score that go into a row of a result, plain numbers."""
    found, pipes = score["classification"], score["pipes"]
    return {
        "F": round(found["f_measure"] or 0.0, 3),
        "right class": f"{found['true_positives']} of {len(pipes) + len(score['missed'])}",
        "false": found["false_positives"],
        "radius RMSE [mm]": _rounded(score["radius"]["rmse_mm"]),
        "length error [%]": _rounded(score["length"]["mean_error_percent"]),
        "scale error [%]": _rounded(score["scale"]["error_percent"]),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def line(name: str, figures: dict[str, Any]) -> str:
    """One line of a table: what was found, the errors, the time."""
    score = figures["score"]
    found, false = score["classification"], [score[kind]["false_positives"] for kind in ("planned", "detection")]
    return (
        f"{name:28} {found['true_positives']:3d} of {len(score['pipes']) + len(score['missed']):3d}  "
        f"false {false[0]}/{false[1]}  F {found['f_measure']:.3f}  "
        f"radius {_shown(score['radius']['rmse_mm'])} mm  length {_shown(score['length']['mean_error_percent'])} %  "
        f"scale {score['scale']['error_percent']:+.4f} %  "
        f"{figures['wall_s']:.0f} s ({figures['cpu_s']:.0f} s of CPU)"
    )


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def main() -> None:
    """Survey the recordings named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.survey", description=__doc__)
    parser.add_argument("recordings", nargs="*", default=["demo"])
    parser.add_argument("--set", action="append", default=[], dest="overrides", help="a setting, as for pipeprog")
    parser.add_argument("--name", default="", help="of the result, where settings make it differ from the plain one")
    arguments = parser.parse_args()
    for text in arguments.recordings:
        recording = named(text)
        print(
            line(arguments.name or recording.name, survey(recording, arguments.overrides, arguments.name)), flush=True
        )


if __name__ == "__main__":
    main()
