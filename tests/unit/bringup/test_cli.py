# SPDX-License-Identifier: Apache-2.0
"""The command as its users meet it: a process, its exit code and its stderr."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup import cli
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_detect.types import Cylinder
from tests.unit.bringup.recordings import write_bag
from tests.unit.detect.plan.ifc_site import write_plan_ifc

BOARDS = """boards:
  - {name: A, circle_radius_mm: 30, centres_mm: [[-130, 80], [130, 80], [40, 10], [-130, -80], [130, -80]]}
  - {name: B, circle_radius_mm: 30, centres_mm: [[-130, 80], [130, 80], [-40, -10], [-130, -80], [130, -80]]}
"""
BOQ = "classes: [{name: DN65, outer_radius_mm: 36.5, planned_length_m: 3.0}]\n"


def pipeprog(*arguments: str | Path, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeprog_bringup.cli", *map(str, arguments)]
    known = {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=known, timeout=120, check=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bill, a recording, and a cloud of one pipe of 36.5 mm in front of a wall."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "boq.yaml").write_text(BOQ)
    write_bag(folder / "bag.mcap")
    rng = np.random.default_rng(0)
    turn, height = rng.uniform(-1.3, 1.3, 20_000), rng.uniform(0, 1.5, 20_000)
    pipe = np.stack([0.0365 * np.sin(turn), -0.1 - 0.0365 * np.cos(turn), height], axis=1)
    wall = rng.uniform([-0.5, -0.001, 0], [0.5, 0.001, 1.5], (40_000, 3))
    write_ply(folder / "cloud.ply", np.concatenate([pipe, wall]))
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """What was `made`, for one test alone."""
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


def test_help_names_every_command() -> None:
    result = pipeprog("--help")
    assert result.returncode == 0
    for command in ("replay", "detect", "ingest", "board", "calibrate", "score", "report", "fleet"):
        assert command in result.stdout


def test_fleet_without_its_packages_says_how_to_get_them(tmp_path: Path) -> None:
    (tmp_path / "dask").mkdir()
    (tmp_path / "dask" / "__init__.py").write_text("raise ModuleNotFoundError(\"No module named 'dask'\", name='dask')")
    result = pipeprog("fleet", "a.mcap", "--out", str(tmp_path / "out"), PYTHONPATH=str(tmp_path))
    assert result.returncode == 1
    assert "there is no dask" in result.stderr
    assert "pip install pipeprog[fleet]" in result.stderr


def test_help_is_instant_since_it_imports_nothing_heavy() -> None:
    code = "import sys, pipeprog_bringup.cli; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {
        "numpy",
        "cv2",
        "rclpy",
        "scipy",
        "sklearn",
        "numba",
        "matplotlib",
        "mcap",
        "open3d",
        "jinja2",
        "yaml",
        "dask",
    }
    assert not heavy & set(modules)
    assert len(modules) < 400, "the interpreter and typer load some 150"


@pytest.mark.parametrize("arguments", [("--version",), ("replay", "--help"), ("score", "--help")])
def test_help_and_version_end_well(arguments: tuple[str, ...]) -> None:
    assert pipeprog(*arguments).returncode == 0


@pytest.mark.parametrize(
    "arguments", [(), ("fly",), ("replay",), ("score", "a"), ("detect", "c.ply", "--nonsense"), ("report", "a")]
)
def test_wrong_usage_is_2(arguments: tuple[str, ...]) -> None:
    result = pipeprog(*arguments)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_detect_writes_its_results_and_says_where(folder: Path) -> None:
    result = pipeprog("detect", folder / "cloud.ply", "--boq", folder / "boq.yaml", "--out", folder / "out")
    assert result.returncode == 0, result.stderr
    assert sorted(file.name for file in (folder / "out").iterdir()) == [
        *("config.yaml", "pipes.json", "progress.csv", "run.json")
    ]
    content = json.loads((folder / "out" / "pipes.json").read_text())
    assert [pipe["class"] for pipe in content["pipes"]] == ["DN65"]
    assert "DN65" in result.stdout
    assert "pipes.json" in result.stdout


@pytest.mark.skipif(find_spec("ifcopenshell") is None, reason="IfcOpenShell is not installed: make setup EXCHANGE=1")
def test_detect_tells_what_the_plan_leaves_out_and_that_it_lies_elsewhere(folder: Path) -> None:
    place = Cylinder(np.array([500.0, 0.0, 0.0]), np.array([500.0, 0.0, 1.5]), 0.0365)
    write_plan_ifc(folder / "plan.ifc", [("a", "DN65", place), ("b", "DN65", place)])
    result = pipeprog("detect", folder / "cloud.ply", "--boq", folder / "plan.ifc", "--out", folder / "out")
    assert result.returncode == 0, result.stderr
    notes = json.loads((folder / "out" / "run.json").read_text())["notes"]
    assert [note for note in notes if "2 pipes share their places" in note]
    assert [note for note in notes if "the plan lies 500 m away from the survey" in note]
    assert "Note: the plan lies 500 m away" in result.stderr


def test_board_writes_a_page_for_each_board(folder: Path) -> None:
    (folder / "boards.yaml").write_text(BOARDS)
    result = pipeprog("board", "boards.yaml", "--paper", "A3", "--out", "boards.pdf", cwd=folder)
    assert result.returncode == 0, result.stderr
    document = (folder / "boards.pdf").read_bytes()
    assert document.startswith(b"%PDF-")
    assert document.count(b"/Type /Page ") == 2
    assert "boards.pdf" in result.stdout


BAD = [
    (("board", "absent.yaml", "--paper", "A3", "--out", "b.pdf"), "absent.yaml"),
    (("board", "boards.yaml", "--paper", "A4", "--out", "b.pdf"), "does not fit on A4: print it on A3"),
    (("board", "boards.yaml", "--paper", "B5", "--out", "b.pdf"), "paper 'B5' is unknown"),
    (("board", "boards.yaml", "--paper", "A3", "--out", "boq.yaml"), "boq.yaml exists"),
    (("replay", "absent.mcap", "--boq", "boq.yaml", "--out", "out"), "no such bag: absent.mcap"),
    (("replay", "boq.yaml", "--boq", "boq.yaml", "--out", "out"), "boq.yaml is not an mcap file"),
    (("replay", "bag.mcap", "--boq", "absent.yaml", "--out", "out"), "absent.yaml"),
    (("replay", "bag.mcap", "--boq", "bad.yaml", "--out", "out"), "bad.yaml"),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--board", "bad.yaml", "--out", "out"), "bad.yaml"),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "used"), "used is not empty"),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "boq.yaml"), "boq.yaml is a file"),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "out", "--rate", "0"), "--rate 0"),
    (
        ("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "out", "--set", "sfm.maper.max_features=3"),
        "did you mean 'sfm.mapper.max_features'",
    ),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "out", "--set", "frames.lockstep=false"), "lockstep"),
    (("replay", "bag.mcap", "--boq", "boq.yaml", "--out", "out", "--image-topic", "/nope"), "/camera/image/compressed"),
    (("detect", "absent.ply", "--boq", "boq.yaml", "--out", "out"), "no such cloud: absent.ply"),
    (("detect", "cloud.ply", "--boq", "bad.yaml", "--out", "out"), "bad.yaml"),
    (("detect", "cloud.ply", "--boq", "boq.yaml", "--out", "/proc/out"), "/proc/out"),
    (
        ("detect", "cloud.ply", "--boq", "boq.yaml", "--out", "out", "--set", "detect.sed=1"),
        "did you mean 'detect.seed'",
    ),
    (("ingest", "absent.mp4", "--camera", "boq.yaml", "--out", "o.mcap"), "boq.yaml is no camera calibration"),
    (("score", "absent.json", "boq.yaml"), "no such file: absent.json"),
    (("report", "absent", "--out", "r.html"), "no such folder: absent"),
]


def test_a_process_with_bad_input_ends_with_1_and_without_a_traceback(folder: Path) -> None:
    result = pipeprog("replay", "absent.mcap", "--boq", "boq.yaml", "--out", "out", cwd=folder)
    assert result.returncode == 1
    assert "no such bag: absent.mcap" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(("arguments", "expected"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_is_1_and_says_what_is_wrong(
    folder: Path,
    arguments: tuple[str, ...],
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In this process: to start one for each takes most of the time."""
    (folder / "bad.yaml").write_text("clases: []\n")
    (folder / "boards.yaml").write_text(BOARDS)
    (folder / "used").mkdir()
    (folder / "used" / "mine.txt").write_text("keep")
    before = sorted(folder.rglob("*"))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["pipeprog", *arguments])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    told = capsys.readouterr().err
    assert expected in told
    assert "Traceback" not in told
    assert sorted(folder.rglob("*")) == before


WITHOUT_ROS = """
import re, sys
from importlib.abc import MetaPathFinder
class NoRos(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if re.match(r"_?rclpy|\\w+_(msgs|interfaces)$", name.partition(".")[0]):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoRos())
from pipeprog_bringup import cli
sys.argv[0] = "pipeprog"
cli.main()
"""


def pipeprog_without_ros(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT_ROS, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=120, check=False)


def test_a_replay_without_ros_says_what_it_needs(folder: Path) -> None:
    result = pipeprog_without_ros(folder, "replay", "bag.mcap", "--boq", "boq.yaml", "--out", "out")
    assert result.returncode == 1
    assert result.stderr.startswith("Error: a replay runs ROS 2 nodes, and this Python cannot import rclpy")
    assert "make setup" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (folder / "out").exists()


def test_detect_score_report_and_board_work_without_ros(folder: Path) -> None:
    (folder / "boards.yaml").write_text(BOARDS)
    (folder / "truth.json").write_text(
        json.dumps({"pipes": [{"start": [0, -0.1, 0], "end": [0, -0.1, 1.5], "radius": 0.0365}]})
    )
    for arguments in (
        ("detect", "cloud.ply", "--boq", "boq.yaml", "--out", "out"),
        ("score", "out/pipes.json", "truth.json"),
        ("report", "out", "--out", "report.html"),
        ("board", "boards.yaml", "--paper", "A3", "--out", "boards.pdf"),
    ):
        result = pipeprog_without_ros(folder, *arguments)
        assert result.returncode == 0, result.stderr
    assert (folder / "report.html").exists()


def test_a_full_disk_is_reported_and_leaves_nothing(folder: Path) -> None:
    """The second file fails to be written, as it would on a full disk."""
    code = (
        "import errno, pathlib, sys\n"
        "from pipeprog_bringup import cli\n"
        "from pipeprog_bringup.results import result_files\n"
        "def full(*arguments): raise OSError(errno.ENOSPC, 'No space left on device')\n"
        "result_files.write_progress = full\n"
        "sys.argv = ['pipeprog', *sys.argv[1:]]\n"
        "cli.main()\n"
    )
    arguments = ["detect", "cloud.ply", "--boq", "boq.yaml", "--out", "out"]
    result = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=folder, check=False
    )
    assert result.returncode == 1
    assert "no space left for the results in out" in result.stderr
    assert not (folder / "out").exists()
