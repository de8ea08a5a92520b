# SPDX-License-Identifier: Apache-2.0
"""A robot like Spot, live: turned fisheye cameras, odometry, images that get lost, a second without any, no board."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pipeprog_bringup.results.scoring import score_files

ROOT = Path(__file__).parents[2]
PIPEPROG = [sys.executable, "-c", "from pipeprog_bringup.cli import main; main()"]
FILMED = "--size vga --fps 2 --seconds 5 --robot --rig 3 --grey --turned --fisheye --drop 0.1 --gaps 1 --allow-hidden"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("site") / "night.mcap"
    maker = [sys.executable, str(ROOT / "bags" / "make_site.py"), "lab", str(path)]
    subprocess.run([*maker, "--seed", "41", *FILMED.split()], check=True, capture_output=True, timeout=300)
    return path


def simulated(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [*PIPEPROG, "simulate-patrol", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=400, check=False)


def test_cameras_of_a_robot_give_metres_without_a_board(recording: Path, tmp_path: Path) -> None:
    boq = str(recording.with_suffix(".boq.yaml"))
    # At half the speed no image is dropped that the recording has, also where other tests run beside.
    done = simulated(str(recording), "--rig", "--boq", boq, "--out", str(tmp_path / "out"), "--rate", "0.5")
    assert (done.returncode, done.stderr) == (0, "")
    figures = score_files(tmp_path / "out" / "night", recording.with_suffix(".truth.json"))
    assert abs(figures["scale"]["error_percent"]) < 0.5
    assert figures["trajectory"]["rms_rigid_mm"] < 5.0
    assert figures["classification"]["true_positives"] >= 4
    assert figures["classification"]["false_positives"] == 0
    assert figures["radius"]["rmse_mm"] < 1.0
