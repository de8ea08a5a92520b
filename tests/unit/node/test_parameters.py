# SPDX-License-Identifier: Apache-2.0
"""Settings as parameters of a real node, and the main function of nodes."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from pipeprog_camera.errors import InputError
from pipeprog_node.parameters import declare, declare_fixed


@dataclass(frozen=True)
class Fusion:
    voxel: float = field(default=0.004, metadata={"description": "edge of a voxel", "unit": "m", "range": (0.001, 0.1)})


@dataclass(frozen=True)
class Config:
    seed: int = field(default=0, metadata={"description": "seed", "unit": "", "range": (0, 9)})
    front_end: str = field(
        default="normals", metadata={"description": "how", "unit": "", "choices": ("normals", "planes")}
    )
    limit: float | None = field(default=None, metadata={"description": "limit", "unit": "s"})
    fusion: Fusion = field(default_factory=Fusion)


@pytest.fixture(scope="module", autouse=True)
def _ros() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.shutdown()


def node_with(overrides: dict[str, object]) -> Node:
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    return Node("tested", parameter_overrides=parameters, start_parameter_services=False)


def test_settings_become_described_read_only_parameters() -> None:
    node = node_with({})
    assert declare(node, Config) == Config()
    voxel = node.describe_parameter("fusion.voxel")
    assert voxel.description == "edge of a voxel [m]"
    assert voxel.read_only
    assert (voxel.floating_point_range[0].from_value, voxel.floating_point_range[0].to_value) == (0.001, 0.1)
    assert node.describe_parameter("front_end").additional_constraints == "one of normals, planes"
    assert not node.set_parameters([Parameter("seed", value=3)])[0].successful
    node.destroy_node()


def test_overrides_reach_the_dataclass_and_the_parameters() -> None:
    node = node_with({"seed": 3, "fusion.voxel": 0.01, "limit": 2})
    assert declare(node, Config) == Config(seed=3, limit=2.0, fusion=Fusion(0.01))
    assert node.get_parameter("limit").value == 2.0
    assert node.get_parameter("fusion.voxel").value == 0.01
    node.destroy_node()


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"fusion.voxl": 0.01}, r"/tested.*'fusion\.voxl'.*'fusion\.voxel'"),
        ({"bord": "a.yaml"}, "'bord'.*'board'"),
        ({"seed": 10}, "seed = 10 is out of range: 0 to 9"),
        ({"seed": "ten"}, "seed = 'ten': it takes a whole number"),
        ({"front_end": "magic"}, "none of its choices: normals, planes"),
    ],
)
def test_overrides_that_cannot_be_used_are_reported(overrides: dict[str, object], text: str) -> None:
    node = node_with(overrides)
    with pytest.raises(InputError, match=text):
        declare(node, Config, extra=("board",))
    node.destroy_node()


def test_what_ros_and_the_node_itself_declare_is_left_alone() -> None:
    node = node_with({"use_sim_time": True, "qos_overrides./image.subscription.depth": 3, "board": "a.yaml"})
    assert declare(node, Config, extra=("board",)) == Config()
    node.destroy_node()


PROGRAM = """
from pipeprog_camera.errors import InputError
from pipeprog_node.main import run
from rclpy.node import Node

class Tested(Node):
    def __init__(self):
        super().__init__("tested")
        {body}

run(Tested)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_node_that_is_stopped_exits_with_0(number: signal.Signals) -> None:
    program = PROGRAM.format(body="self.create_timer(0.01, lambda: print('up', flush=True))")  # says that it spins
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")


def test_mistake_of_the_user_is_one_line_and_exit_1() -> None:
    program = PROGRAM.format(body="raise InputError('no bill of quantities: set boq')")
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20)
    assert (process.returncode, process.stderr) == (1, "error: no bill of quantities: set boq\n")


def test_missing_parameter_file_is_reported_without_traceback() -> None:
    program = PROGRAM.format(body="pass")
    arguments = ["--ros-args", "--params-file", "missing.yaml"]
    process = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=20)
    assert process.returncode == 1
    assert "missing.yaml" in process.stderr
    assert "Traceback" not in process.stderr


def test_a_fixed_parameter_keeps_the_value_of_the_start() -> None:
    node = Node("fixed", parameter_overrides=[Parameter("board", value="site.yaml")])
    try:
        assert declare_fixed(node, "board", "", "file of the boards") == "site.yaml"
        assert declare_fixed(node, "lockstep", False, "how it is run") is False
        results = node.set_parameters([Parameter("board", value="other.yaml"), Parameter("lockstep", value=True)])
        assert not any(result.successful for result in results)
        assert node.get_parameter("board").value == "site.yaml"
    finally:
        node.destroy_node()


@pytest.mark.parametrize(("name", "default", "given"), [("board", "", 5), ("lockstep", False, "yes")])
def test_a_fixed_parameter_of_another_type_is_an_input_error(name: str, default: Any, given: object) -> None:
    node = Node("fixed", parameter_overrides=[Parameter(name, value=given)])
    try:
        with pytest.raises(InputError, match=f"{name} = .*{given}"):
            declare_fixed(node, name, default, "")
    finally:
        node.destroy_node()
