# SPDX-License-Identifier: Apache-2.0
"""The same frames through the live graph and through a replay: the same pipes?

    .venv/bin/python -m benchmarks.live_replay

The robot sends each image of the demo once, under its own stamp, and the next one when the SfM has answered to all
keyframes, so that nothing is dropped; the survey is the action's, over DDS. It is done twice: with the settings that
users get, and without the maps and pipes that are shown while it is filmed. Writes results/live_replay.json.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

from benchmarks.live_graph import BOARD, BOQ, DEMO, LiveGraph, Robot
from benchmarks.recordings import ROOT
from benchmarks.survey import COMMAND, RESULTS, commit
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.recording.bag import Bag

OUT = ROOT / "out" / "live_replay"
SAME = 0.1  # m: pipes of one class are a diameter and more apart, and ends of short ones differ by centimetres


def compared(live: Sequence[dict[str, Any]], replayed: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each pipe of either result, the same pipe being that of the same class whose middle is nearest."""
    rows, left = [], list(live)
    for other in replayed:
        own = [one for one in left if one["class"] == other["class"] and _between(one, other) < SAME]
        row: dict[str, Any] = {"pipe of the replay": other["id"], "class": other["class"]}
        if own:
            one = min(own, key=lambda pipe: _between(pipe, other))
            left.remove(one)
            row["live"] = one["id"]
            row["radius, difference [mm]"] = round(1e3 * abs(one["radius"] - other["radius"]), 3)
            row["length, difference [mm]"] = round(1e3 * abs(one["length"] - other["length"]), 2)
        rows.append(row)
    return rows + [{"live": one["id"], "class": one["class"]} for one in left]


def _between(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Metres between the middles of two pipes."""
    return float(np.linalg.norm(np.mean([one["start"], one["end"]], 0) - np.mean([other["start"], other["end"]], 0)))


def surveyed(folder: Path, is_shown: bool) -> Path:
    """The results of a live survey of the demo; `is_shown`: with maps and pipes while it is filmed, as usual."""
    folder.mkdir()
    with LiveGraph(folder, {}, intermediate=is_shown) as graph:
        rclpy.init()
        try:
            robot = Robot(graph, list(Bag.open(DEMO)), patient=True)
            robot.activate()
            answer = robot.survey("live")
        finally:
            rclpy.try_shutdown()
    if answer.result.error_code:
        raise RuntimeError(answer.result.error_msg)
    return Path(answer.result.folder)


def replayed(folder: Path) -> Path:
    """The results of a replay of the demo."""
    command = [
        str(COMMAND),
        "replay",
        str(DEMO),
        "--boq",
        str(BOQ),
        "--board",
        str(BOARD),
        "--out",
        str(folder),
        "--force",
    ]
    subprocess.run(command, check=True)
    return folder


def _keyframes(file: Path) -> set[str]:
    with file.open(newline="", encoding="utf-8") as stream:
        return {row["stamp"] for row in csv.DictReader(stream) if row["chosen"] == "1"}


def _names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def main() -> None:
    """Measures and writes."""
    shutil.rmtree(OUT, ignore_errors=True)
    replay = replayed(OUT / "replay")
    rows: list[dict[str, Any]] = []
    findings: dict[str, Any] = {}
    with private_network(OUT):  # one for both: a process reads the profile of its network once
        for name, is_shown in (("as it is", True), ("the last map alone", False)):
            live = surveyed(OUT / name.replace(" ", "_"), is_shown)
            chosen = [_keyframes(folder / "frames.csv") for folder in (live, replay)]
            findings[f"keyframes, {name}: live, replay, both"] = [*map(len, chosen), len(chosen[0] & chosen[1])]
            findings[f"files that the live folder lacks, {name}"] = sorted(_names(replay) - _names(live))
            pipes = [json.loads((folder / "pipes.json").read_text())["pipes"] for folder in (live, replay)]
            rows += [{"survey": name, **row} for row in compared(*pipes)]
    result = {
        "title": "Live and replay of the same frames",
        "command": "python -m benchmarks.live_replay",
        "commit": commit(),
        "findings": findings,
        "rows": rows,
    }
    (RESULTS / "live_replay.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
