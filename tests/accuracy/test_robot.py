# SPDX-License-Identifier: Apache-2.0
"""Metres without a board: a robot's odometry, IMU and mounting in the recording, held against the truth."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings import made, site
from benchmarks.survey import COMMAND
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_bringup.results.scoring import score_files

RECORDING = site("lab", 31, "--size=480p", "--seconds=8", "--fps=2.5", "--allow-hidden", "--robot")


@pytest.mark.timeout(1800)
def test_odometry_gives_metres_and_the_imu_what_is_up(tmp_path: Path) -> None:
    recording = made(RECORDING)
    boq, truth = recording.beside("boq.yaml"), recording.beside("truth.json")
    subprocess.run([COMMAND, "replay", str(recording.bag), "--boq", str(boq), "--out", str(tmp_path)], check=True)
    scale = json.loads((tmp_path / "pipes.json").read_text())["scale"]
    figures = score_files(tmp_path / "pipes.json", truth)
    print(f"scale {figures['scale']['error_percent']:+.3f} %, sigma {100 * scale['sigma']:.3f} %")
    assert scale["source"] == "odometry"
    assert scale["sigma"] < 0.02
    assert abs(figures["scale"]["error_percent"]) < 300 * scale["sigma"]

    stamps, map_from_camera = read_trajectory(tmp_path / "trajectory.tum")
    world_from_camera = np.array(json.loads(truth.read_text())["camera_to_world"])
    frames = np.round((stamps - stamps[0]) * 1e-9 * 2.5).astype(int)
    turns = np.einsum("nij,nkj->nik", world_from_camera[frames, :3, :3], map_from_camera[:, :3, :3])
    up = turns.mean(0)[:, 2]
    tilt = np.degrees(np.arccos(up[2] / np.linalg.norm(up)))
    print(f"z of the map {tilt:.2f} degrees off the vertical")
    # An accelerometer's bias of 0.03 m/s^2 is a sixth of a degree.
    assert tilt < 1.0
