# SPDX-License-Identifier: Apache-2.0
"""Each program of examples/ runs as its docstring says, and what it prints holds."""

from __future__ import annotations

import itertools
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy

from pipeprog_bringup.results import result_files
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe
from tests.unit.bringup.patrol.fake_robot import FakeRobot, fake_robot
from tests.unit.examples import fake_spot_sdk

ROOT = Path(__file__).parents[3]


@pytest.fixture
def robot() -> Iterator[FakeRobot]:
    with fake_robot() as robot:
        yield robot


def run(name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=280, check=False)


def example(name: str, *arguments: str | Path) -> list[str]:
    """The lines that a program prints."""
    result = run(name, *arguments)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


def asked(robot: FakeRobot) -> list[str]:
    """What a robot was asked for; a goal whose answer is lost is sent again, and counts once."""
    return [said for said, _ in itertools.groupby(robot.said)]


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


def test_nav2_waypoints(robot: FakeRobot) -> None:
    waypoints = ("--at", "1", "2", "90", "--at", "6", "2", "90", "--at", "9", "2", "0")
    assert example("nav2_waypoints.py", *waypoints, "--survey-id", "monday") == ["results: /surveys/monday"]
    assert asked(robot) == ["follow 1", "survey monday", "follow 6 9", "end"]

    robot.said.clear()
    robot.blocked = {"9"}
    missed = run("nav2_waypoints.py", *waypoints, "--survey-id", "tuesday")
    assert missed.returncode == 1
    assert "missed waypoints [1]" in missed.stderr
    assert missed.stdout == "results: /surveys/tuesday\n"  # what was filmed has its results
    assert robot.said[-1] == "end"


def test_spot_navigate_to(robot: FakeRobot) -> None:
    walk = ("begin", "middle", "end_of_wall", "--home", "dock", "--survey-id", "monday")
    assert example("spot_navigate_to.py", *walk) == ["results: /surveys/monday"]
    assert asked(robot) == ["walk begin", "survey monday", "walk middle", "walk end_of_wall", "end", "walk dock"]

    robot.said.clear()
    robot.blocked = {"middle"}
    stuck = run("spot_navigate_to.py", *walk)
    assert stuck.returncode == 1
    assert "not come to middle: no way" in stuck.stderr
    assert asked(robot) == ["walk begin", "survey monday", "walk middle", "end", "walk dock"]


def test_spot_remote_mission(robot: FakeRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, module in fake_spot_sdk.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    program = runpy.run_path(str(ROOT / "examples" / "spot_remote_mission.py"))
    client = program["SurveyClient"](rclpy.create_node("mission"), start_seconds=5.0)
    mission = program["SurveyMission"](client)

    def action() -> list[str]:
        """The states that an action of the walk goes through."""
        session = mission.EstablishSession(fake_spot_sdk.Request(), None).session_id
        states: list[str] = []
        while not states or states[-1] == "RUNNING":
            answer = mission.Tick(fake_spot_sdk.Request(session), None)
            states.append(fake_spot_sdk.TICKED[answer.status] + answer.error_message)
        assert mission.TeardownSession(fake_spot_sdk.Request(session), None).status == 1
        return states

    robot.failing = ["", "no board was seen"]
    try:
        assert action() == ["SUCCESS"]
        assert action()[-1] == "SUCCESS"
        assert robot.said[0].startswith("survey")
        assert robot.said[1] == "end"
        assert action() == ["SUCCESS"]
        assert action()[-1] == "FAILUREno board was seen"
    finally:
        client.close()


def test_programs_for_robots_have_at_most_a_hundred_lines() -> None:
    for name in ("nav2_waypoints", "spot_navigate_to", "spot_remote_mission"):
        assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) <= 100, name


def test_every_example_has_its_test() -> None:
    names = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert {f"test_{name}" for name in names} <= set(globals())
