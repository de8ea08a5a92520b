# SPDX-License-Identifier: Apache-2.0
"""`pipeprog calibrate` on hand-held films of a board whose camera is known: 30 s, 720p, noise, blur of 4 ms.

    .venv/bin/python -m benchmarks.board_calibration [SEED ...]

The films are made once by bags/make_board_film.py, a frame in 0.3 s. Prints the rows and writes
results/board_calibration.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recordings import FOLDER, ROOT
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.calibrate import Request, calibrate
from pipeprog_camera.camera import Camera
from pipeprog_sfm.calibration.calibration import Calibration

GRID = 20  # points of the image in each direction at which the lenses are compared


def main(seeds: list[int]) -> None:
    """Calibrate with a film of each seed."""
    rows = [measured(film(seed), seed) for seed in seeds]
    result = {
        "title": "A camera from a film of a board",
        "command": "python -m benchmarks.board_calibration",
        "must": "f to 0.05 %, reprojection to 0.1 px, read-out to 3 %",
        "commits": sorted({row.pop("commit") for row in rows}),
        "rows": rows,
    }
    (RESULTS / "board_calibration.json").write_text(json.dumps(result, indent=1) + "\n")


def film(seed: int) -> Path:
    """The recording of a seed, made now if it is not there."""
    path = FOLDER / f"board_film_{seed}.mcap"
    if not path.exists():
        command = [sys.executable, "bags/make_board_film.py", str(path), "--seed", str(seed)]
        subprocess.run(command, cwd=ROOT, check=True)
    return path


def measured(path: Path, seed: int) -> dict[str, Any]:
    """What was found beside what is true."""
    started, cpu = time.monotonic(), time.process_time()
    out = path.with_suffix(".camera.yaml")
    found = calibrate(Request(path, path.with_suffix(".board.yaml"), out, force=True), lambda share, stage: None)
    seconds, cpu = time.monotonic() - started, time.process_time() - cpu
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    camera = found.camera
    fx, fy, cx, cy = truth["camera"]
    true = Camera(camera.width, camera.height, fx, fy, cx, cy, "plumb_bob", tuple(truth["distortion"]))
    readout = found.readout or 0.0
    row = {
        "commit": commit(),
        "seed": seed,
        "images": found.views,
        "focal_error_percent": round(100 * (camera.fx / true.fx - 1), 4),
        "focal_sigma_percent": round(100 * found.sigmas["fx"] / camera.fx, 4),
        "lens_rms_px": round(lens_difference(found, true), 3),
        "reprojection_px": round(found.rms, 3),
        "readout_ms": round(1e3 * readout, 3),
        "readout_error_percent": round(100 * (readout / truth["readout"] - 1), 2),
        "readout_sigma_percent": round(100 * found.sigmas["readout"] / truth["readout"], 2),
        "coverage_percent": round(100 * found.coverage, 1),
        "seconds": round(seconds),
        "cpu_seconds": round(cpu),
    }
    print(row, flush=True)
    return row


def lens_difference(found: Calibration, true: Camera) -> float:
    """Root mean square distance [px] of where the two cameras show a direction, over the image.

    A turn of the camera that makes up for a shifted principal point counts as none: it is in no picture of a site.
    """
    columns, rows = (np.linspace(0, size - 1, GRID) for size in (true.width, true.height))
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    ideal = (true.undistort_points(pixels) - [true.cx, true.cy]) / [true.fx, true.fy]
    camera = found.camera
    difference = np.zeros_like(pixels)
    rays = np.c_[ideal, np.ones(len(ideal))]
    for _ in range(3):
        shown = camera.distort_points(rays[:, :2] / rays[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy])
        difference = shown - pixels
        turn = np.mean(difference, axis=0) / camera.fx
        rays = rays - np.c_[turn[0] * rays[:, 2], turn[1] * rays[:, 2], -(rays[:, :2] @ turn)]
    return float(np.sqrt((difference**2).sum(1).mean()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="*", type=int, default=[1])
    main(parser.parse_args().seeds)
