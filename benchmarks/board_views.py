# SPDX-License-Identifier: Apache-2.0
"""Experiment 1 of the paper: how many views of the board the scale takes, circle centres corrected or not.

    .venv/bin/python -m benchmarks.board_views [SURVEY RECORDING ...]

For each number of views that see the board, scales from random choices of that many, with the poses of surveys that are
there already (folders of out/surveys, each with the recording it is of; the demo's where none are named); what each
scale makes of one pipe's radius is set against the truth. Writes results/board_views.json and Figure 8. The errors of
each survey are kept in its folder.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from rclpy.serialization import deserialize_message
from rich.progress import track
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import DEMO, ROOT, Recording, named
from benchmarks.survey import RESULTS, RUNS, survey
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_bringup.results.scoring import score_files
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.metric.metric_tracker import MetricTracker
from pipeprog_sfm.metric.scale import NoScaleError

CHOICES = 50  # as in the paper
VIEWS = range(2, 36)  # as in the paper
PIPE = 0.0365  # m; the paper follows one pipe, and this is the lab's commonest
FIGURE = ROOT / "docs" / "images" / "experiment_figure_8.png"
VARIANTS = {"corrected": True, "as imaged": False}


def main(runs: Sequence[tuple[Path, Recording]]) -> None:
    """Print the table and write results/board_views.json and the figure, all surveys together."""
    errors: defaultdict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)
    failures: Counter[tuple[str, int]] = Counter()
    pipes = []
    for run, recording in runs:
        known = _kept(run, recording)
        pipes.append(known["pipe"])
        for choice in known["choices"]:
            key = choice["variant"], choice["views"]
            errors[key] += choice["errors"]
            failures[key] += CHOICES - len(choice["errors"])
    rows = []
    for views in VIEWS:
        row: dict[str, float | int] = {"views": views}
        for variant in VARIANTS:
            if found := errors[variant, views]:
                scale, radius = np.array(found).T
                row[f"{variant}: scale RMSE [%]"] = _rms(scale)
                row[f"{variant}: radius RMSE [mm]"] = _rms(radius)
                row[f"{variant}: worst radius [mm]"] = round(float(np.abs(radius).max()), 4)
                row[f"{variant}: choices"] = len(found)
                row[f"{variant}: without a scale"] = failures[variant, views]
        if len(row) > 1:
            rows.append(row)
            print(row)
    result = {
        "title": "Experiment 1: the scale from few views of the board",
        "command": "make experiments",
        "pipes": pipes,
        "findings": _findings(rows),
        "rows": rows,
    }
    (RESULTS / "board_views.json").write_text(json.dumps(result, indent=1) + "\n")
    _draw(rows)


def _kept(run: Path, recording: Recording) -> dict[str, Any]:
    """Which pipe of a survey is followed, and the errors of every choice; measured where the survey is newer."""
    kept = run / "board_views.json"
    if not kept.exists() or kept.stat().st_mtime < (run / "pipes.json").stat().st_mtime:
        kept.write_text(json.dumps(_choose(run, recording)) + "\n")
    known: dict[str, Any] = json.loads(kept.read_text())
    return known


def _choose(run: Path, recording: Recording) -> dict[str, Any]:
    """The pipe, and for each variant and number of views the errors (scale [%], radius [mm]) of the choices."""
    score = score_files(run / "pipes.json", recording.beside("truth.json"))
    pipe = min(score["pipes"], key=lambda entry: abs(entry["true_radius"] - PIPE))
    detected = json.loads((run / "pipes.json").read_text())["pipes"]
    measured = next(entry["radius"] for entry in detected if entry["id"] == pipe["id"])
    choices = []
    for variant, corrected in VARIANTS.items():
        tracker, poses = tracked(run, recording.beside("board.yaml"), corrected)
        seeing = list(poses)
        for views in track([count for count in VIEWS if count <= len(seeing)], f"{run.name}, centres {variant}"):
            rng = np.random.default_rng(views)
            errors = []
            for _ in range(CHOICES):
                chosen = rng.choice(len(seeing), views, replace=False)
                try:
                    factor = tracker.estimate({seeing[index]: poses[seeing[index]] for index in chosen}).scale
                except NoScaleError:
                    continue
                scale = 100 * (factor * (1 + score["scale"]["error_percent"] / 100) - 1)
                errors.append((scale, 1e3 * (measured * factor - pipe["true_radius"])))
            choices.append({"variant": variant, "views": views, "errors": errors})
    return {"pipe": f"{1e3 * pipe['true_radius']:g} mm of `{run.name}`", "choices": choices}


def _findings(rows: Sequence[dict[str, float | int]]) -> dict[str, float | int]:
    """The paper's two statements, as seen here: correction halves the error, five views suffice."""
    corrected, imaged = (f"{variant}: scale RMSE [%]" for variant in VARIANTS)
    best = min(row[corrected] for row in rows)
    return {
        "error as imaged over corrected, median over the numbers of views": round(
            float(np.median([row[imaged] / row[corrected] for row in rows if imaged in row])), 2
        ),
        "views from which on the error is at most 1.5 times the least": next(
            row["views"]
            for number, row in enumerate(rows)
            if all(later[corrected] <= 1.5 * best for later in rows[number:])
        ),
    }


def _draw(rows: Sequence[dict[str, float | int]]) -> None:
    figure = Figure(figsize=(8, 3), layout="constrained")
    for panel, what in zip(figure.subplots(1, 2), ("scale RMSE [%]", "radius RMSE [mm]"), strict=True):
        for variant in VARIANTS:
            key = f"{variant}: {what}"
            panel.plot([row["views"] for row in rows], [row.get(key) for row in rows], "o-", ms=3, label=variant)
        panel.set(xlabel="views of the board", ylabel=what)
        panel.set_ylim(bottom=0)
    figure.axes[0].legend(title="circle centres")
    figure.savefig(FIGURE, dpi=80)


def _rms(errors: np.ndarray) -> float:
    return round(float(np.sqrt(np.mean(errors**2))), 4)


def tracked(run: Path, board: Path, corrected: bool) -> tuple[MetricTracker, dict[int, np.ndarray]]:
    """The boards in the keyframes of a run, and the poses camera_from_map, by stamp, of those that see one."""
    bag = Bag.open(run / "out.mcap")
    config = dataclasses.replace(SfmConfig().board, eccentricity=corrected)
    tracker = MetricTracker(load_board_file(board), config)
    seeing = set()
    for frame in bag:
        encoded = np.frombuffer(deserialize_message(frame.data, CompressedImage).data, np.uint8)
        gray = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        if gray is not None and tracker.add(frame.stamp, gray, bag.camera):
            seeing.add(frame.stamp)
    stamps, map_from_camera = read_trajectory(run / "trajectory.tum")
    poses = zip(stamps.tolist(), np.linalg.inv(map_from_camera), strict=True)
    return tracker, {stamp: pose for stamp, pose in poses if stamp in seeing}


if __name__ == "__main__":
    if len(sys.argv) == 1:
        survey(DEMO)
        main([(RUNS / DEMO.name, DEMO)])
    else:
        main([(Path(run), named(bag)) for run, bag in zip(sys.argv[1::2], sys.argv[2::2], strict=True)])
