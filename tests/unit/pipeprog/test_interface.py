# SPDX-License-Identifier: Apache-2.0
"""The Python interface as a notebook meets it: a process without ROS."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pipeprog
from pipeprog_camera.errors import InputError

# As where ROS is not installed: each of these imports fails.
NO_ROS = "import sys; sys.modules.update(dict.fromkeys(('rclpy', 'pipeprog_msgs', 'sensor_msgs', 'std_msgs')));"
FIVE_LINES = """
import numpy as np, pipeprog
rng = np.random.default_rng(0)
turn, height = rng.uniform(-1.3, 1.3, 20_000), rng.uniform(0, 1.5, 20_000)
points = np.stack([0.0365 * np.sin(turn), -0.0365 * np.cos(turn), height], axis=1)
print(*[f"{pipe.class_name} {pipe.cylinder.radius:.5f}" for pipe in pipeprog.detect(points, {"DN65": 0.0365})])
"""


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", NO_ROS + code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_pipes_of_a_cloud_in_five_lines_without_ros() -> None:
    result = python(FIVE_LINES)
    name, radius = result.stdout.split()
    assert (name, float(radius)) == ("DN65", pytest.approx(0.0365, abs=1e-4)), result.stderr


def test_import_is_instant_and_loads_nothing() -> None:
    code = "import time; t = time.process_time(); import pipeprog; print(time.process_time() - t, *sys.modules)"
    seconds, *modules = python(code).stdout.split()
    assert float(seconds) < 0.1
    assert not {"numpy", "scipy", "cv2", "numba", "open3d"} & set(modules)


@pytest.mark.parametrize("name", pipeprog.__all__)
def test_every_exported_name_is_there(name: str) -> None:
    assert getattr(pipeprog, name).__doc__


def test_no_other_name_is_there() -> None:
    assert set(pipeprog.__all__) <= set(dir(pipeprog))
    with pytest.raises(AttributeError, match="detct"):
        _ = pipeprog.detct


@pytest.mark.parametrize("command", ["detect", "score", "report", "board", "ingest"])
def test_commands_load_without_ros(command: str) -> None:
    code = "from pipeprog_bringup.cli import main; sys.argv[0] = 'pipeprog'; main()"
    result = python(code, command, "--help")
    assert result.returncode == 0, result.stderr
    assert "Usage: pipeprog" in result.stdout


def test_radii_without_names_name_their_classes() -> None:
    turn, height = np.meshgrid(np.linspace(-1.3, 1.3, 80), np.arange(0, 1.5, 0.002))
    points = np.stack([0.0575 * np.sin(turn), -0.0575 * np.cos(turn), height], axis=-1).reshape(-1, 3)
    (pipe,) = pipeprog.detect(points, [0.0365, 0.0575])
    assert pipe.class_name == "57.5 mm"
    assert pipe.cylinder.radius == pytest.approx(0.0575, abs=1e-4)
    assert pipe.cylinder.length == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize(
    ("points", "radii", "complaint"),
    [
        (np.zeros((5, 2)), [0.1], "shape"),
        (np.full((5, 3), np.nan), [0.1], "finite"),
        (np.zeros((5, 3)), [], "no class"),
        (np.zeros((5, 3)), [-0.1], "above zero"),
    ],
)
def test_input_that_cannot_be_used_is_an_input_error(points: np.ndarray, radii: list[float], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        pipeprog.detect(points, radii)


def test_the_readme_shows_these_lines() -> None:
    assert "pipeprog.detect(" in (Path(__file__).parents[3] / "README.md").read_text()
