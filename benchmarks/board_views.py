"""Experiment 1 of the paper: how many views of the board the scale takes, circle centres corrected or not.

    .venv/bin/python -m benchmarks.board_views [RUN TRUTH.json BOARD.yaml]

For each number of views that see the board, scales from random choices of that many, with the poses of a survey that is
there already (out/surveys/demo, or RUN); what each scale makes of one pipe's radius is set against the truth.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from pathlib import Path

import cv2
import numpy as np
from rclpy.serialization import deserialize_message
from rich.progress import track
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import DEMO
from benchmarks.survey import RESULTS, RUNS, survey
from pipeprog_bringup.bag import Bag
from pipeprog_bringup.results import read_trajectory
from pipeprog_bringup.score import score_files
from pipeprog_sfm.board_tracker import BoardTracker
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.scale import NoScaleError
from pipeprog_sfm.target_file import load_targets

CHOICES = 50  # as in the paper
VIEWS = (2, 3, 4, 5, 6, 8, 10, 15, 20, 25, 30, 35)  # the paper's range
PIPE = 0.0365  # m; the paper follows one pipe, and this is its commonest


def main(run: Path, truth: Path, board: Path) -> None:
    """Print the table and write results/board_views.json."""
    score = score_files(run / "pipes.json", truth)
    pipe = min(score["pipes"], key=lambda entry: abs(entry["true_radius"] - PIPE))
    measured = next(
        entry["radius"] for entry in json.loads((run / "pipes.json").read_text())["pipes"] if entry["id"] == pipe["id"]
    )
    rows: dict[int, dict[str, float | int]] = {}
    for corrected in (True, False):
        tracker, poses = _tracked(run, board, corrected)
        seeing = list(poses)
        for views in track([count for count in VIEWS if count <= len(seeing)], f"centres corrected: {corrected}"):
            rng = np.random.default_rng(views)
            scales = []
            for _ in range(CHOICES):
                chosen = rng.choice(len(seeing), views, replace=False)
                with contextlib.suppress(NoScaleError):
                    scales.append(tracker.estimate({seeing[index]: poses[seeing[index]] for index in chosen}).scale)
            name, row = "corrected" if corrected else "as imaged", rows.setdefault(views, {"views": views})
            factors = np.array(scales)
            row[f"{name}: scale RMSE [%]"] = _rms(100 * (factors * (1 + score["scale"]["error_percent"] / 100) - 1))
            row[f"{name}: radius RMSE [mm]"] = _rms(1e3 * (measured * factors - pipe["true_radius"]))
            row[f"{name}: no scale of {CHOICES}"] = CHOICES - len(scales)
    result = {
        "title": f"Experiment 1: views of the board ({1e3 * pipe['true_radius']:g} mm pipe of `{run.name}`)",
        "rows": list(rows.values()),
    }
    (RESULTS / "board_views.json").write_text(json.dumps(result, indent=1) + "\n")
    for row in rows.values():
        print(row)


def _rms(errors: np.ndarray) -> float:
    return round(float(np.sqrt(np.mean(errors**2))), 4)


def _tracked(run: Path, board: Path, corrected: bool) -> tuple[BoardTracker, dict[int, np.ndarray]]:
    """The boards in the keyframes of a run, and the poses camera_from_map, by stamp, of those that see one."""
    bag = Bag.open(run / "out.mcap")
    config = dataclasses.replace(SfmConfig().board, eccentricity=corrected)
    tracker = BoardTracker(load_targets(board), config)
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
        main(RUNS / DEMO.name, DEMO.beside("truth.json"), DEMO.beside("board.yaml"))
    else:
        main(*(Path(argument) for argument in sys.argv[1:]))
