# SPDX-License-Identifier: Apache-2.0
"""Runners that take the place of a replay: they answer at once, by a plan that the recording's content holds."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from pipeprog_bringup.fleet.task import Refused, SurveyFailure, Task, Unwanted, Watcher

BOQ = "classes: [{name: DN65, outer_radius_mm: 36.5, planned_length_m: 3.0}]\n"


def write_results(folder: Path, metres: float) -> None:
    """What a replay leaves, as far as a fleet looks at it."""
    pipe = {"id": "p01", "start": [0, 0, 0], "end": [metres, 0, 0], "radius": 0.0365, "radius_sigma": 2e-4}
    pipe |= {"length": metres, "class": "DN65", "class_probability": 1.0, "class_kmeans": "DN65", "ambiguous": False}
    pipe |= {"visible_arc_deg": 120.0, "rmse": 1e-3, "points": 9}
    progress = {
        "class": "DN65",
        "outer_radius": 0.0365,
        "planned_m": 3.0,
        "installed_m": metres,
        "percent": 100 * metres / 3,
    }
    content = {"frame_id": "map", "scale": {"source": "board", "sigma": 0.0004}, "pipes": [pipe], "classes": [progress]}
    (folder / "colmap").mkdir(parents=True)
    (folder / "pipes.json").write_text(json.dumps({**content, "runs": []}))
    (folder / "colmap" / "images.txt").write_text("# two views\n")
    (folder / "trajectory.tum").write_text(f"{1.7e9 + 1e5 * metres:.9f} 0 0 0 0 0 0 1\n")
    (folder / "report.html").write_text("<p>a report</p>")
    run = {"command": "replay", "bag": "recording/x", "keyframes": 9, "registered": 8, "losses": ["the tail is torn"]}
    (folder / "run.json").write_text(json.dumps({**run, "finished": "2026-01-02T03:04:05+00:00", "files": []}))


def survey_by_plan(task: Task, folder: Path, watcher: Watcher) -> dict[str, Any]:
    """Does what the recording says.

    A number: the metres that are found. `refuse`, `fail`: always. `fail once`, `kill once`, `kill`: as recorded beside
    --out, in a file that takes a line a try; `kill` is of the worker. `wait`: until nobody waits any more.
    """
    (recording,) = (folder / "recording").iterdir()
    plan = recording.read_text().split("\n")[0]
    tries = Path(f"{task.out}.tries")
    tries.mkdir(parents=True, exist_ok=True)
    with (tries / task.name).open("a+") as record:
        record.seek(0)
        is_first = not record.read()
        record.write(f"{os.getpid()}\n")
    watcher.tell(
        {"stage": "replay", "frames": 10, "considered": 4, "keyframes": 2, "registered": 1, "log": "it works\n"}
    )
    if plan == "refuse":
        raise Refused("it is no recording", "Error: it is no recording\n")
    if plan == "fail" or (plan == "fail once" and is_first):
        raise SurveyFailure("a node died", "what the node said\n")
    if plan == "kill" or (plan == "kill once" and is_first):
        time.sleep(0.3)  # in which what was told is sent
        os.kill(os.getpid(), signal.SIGKILL)
    while plan == "wait":
        if not watcher.is_wanted():
            raise Unwanted
        time.sleep(0.02)
    write_results(folder / "results", float(plan) if plan[0].isdigit() else 1.0)
    return {"replay_s": 0.0, "peak_mb": 700}
