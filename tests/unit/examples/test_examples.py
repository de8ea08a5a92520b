# SPDX-License-Identifier: Apache-2.0
"""Each program of examples/ runs as its docstring says, and what it prints holds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.results import result_files
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe

ROOT = Path(__file__).parents[3]


def example(name: str, *arguments: str | Path) -> list[str]:
    """The lines that a program prints."""
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=280, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


def test_detect_on_a_cloud() -> None:
    lines = example("detect_on_a_cloud.py")
    assert [line.split(":")[0] for line in lines] == ["DN65", "DN100"]
    # A millimetre of noise in 20 000 points: a tenth of it remains.
    assert all(abs(float(line.split("(")[1].split()[0])) < 0.1 for line in lines)


def test_survey_from_python() -> None:
    data = (ROOT / "bags" / name for name in ("demo.mcap", "demo.board.yaml", "demo.boq.yaml"))
    poses, scale, *pipes = example("survey_from_python.py", *data, "--seconds", "2", "--half")
    registered, _, keyframes, *_ = poses.split()
    assert registered == keyframes
    assert scale.startswith("scale from board")
    radii = {line.split()[1]: float(line.split(" r ")[1].split()[0]) for line in pipes}
    # Half the pixels and a few views, which see these two whole: half a pixel is 0.5 mm.
    assert radii["DN100"] == pytest.approx(57.5, abs=0.5)
    assert radii["DN200"] == pytest.approx(109.5, abs=0.5)


def test_own_scale_source() -> None:
    found, error = example("own_scale_source.py")
    assert "from total_station" in found
    sigma = float(found.split("sigma ")[1].split()[0])
    assert abs(float(error.split("error ")[1].split()[0])) < 4 * sigma


def test_read_results_into_pandas(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    pipes = [
        Pipe("p01", Cylinder(np.zeros(3), np.array([0, 0, 1.5]), 0.0367), 1e-4, "DN65", 1.0, 2.0, 1e-3, 9),
        Pipe("p02", Cylinder(np.zeros(3), np.array([0, 2.0, 0]), 0.0365), 1e-4, "DN65", 1.0, 2.0, 1e-3, 9),
    ]
    progress = [ClassProgress("DN65", 0.0365, 7.0, 3.5, 50.0)]
    result_files.write_pipes(tmp_path / "pipes.json", Product(pipes, progress, []), result_files.Scale("board", 4e-4))
    lines = example("read_results_into_pandas.py", tmp_path)
    (row,) = (line.split() for line in lines if line.startswith("p01"))
    assert [float(cell) for cell in row[2:]] == [0.0367, 0.0001, 2.0, 1.5, 0.75]
    assert lines[-1].split() == ["DN65", "2", "3.5"]


def test_every_example_has_its_test() -> None:
    names = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert {f"test_{name}" for name in names} <= set(globals())
