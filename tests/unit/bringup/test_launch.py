# SPDX-License-Identifier: Apache-2.0
"""The nodes that the launch file starts, with the packages `launch` and `launch_ros` replaced: no wheel has them."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

LAUNCH_FILE = Path(__file__).parents[3] / "src" / "pipeprog_bringup" / "launch" / "pipeprog.launch.py"
MODULES = (
    *("launch", "launch.actions", "launch.conditions", "launch.substitutions"),
    *("launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions"),
)


class Made:
    """Stands for an object of the launch packages: its class's name, and what it was made of."""

    def __init__(self, kind: str, *arguments: Any, **named: Any) -> None:
        self.kind, self.arguments, self.named = kind, arguments, named


class Recorder(ModuleType):
    """A module in which every name is a class of objects that are recorded."""

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments, **named: Made(name, *arguments, **named)


def in_words(value: Any) -> Any:
    """A substitution as launch files in XML write it."""
    if isinstance(value, list):
        return "".join(map(in_words, value))
    return f"$(var {value.arguments[0]})" if isinstance(value, Made) else value


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> list[Made]:
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, Recorder(name))
    description = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()
    return [each for each in description.arguments[0] if each.kind in ("Node", "LifecycleNode")]


def test_every_node_has_its_enclave_and_the_severity_of_logs(nodes: list[Made]) -> None:
    assert {node.named["name"] for node in nodes} == {"frames", "sfm", "detect", "survey"}
    for node in nodes:
        given = [in_words(word) for word in node.named["ros_arguments"]]
        enclave = f"$(var enclaves)/{node.named['name']}"
        assert given == ["--log-level", "$(var log_level)", "--enclave", enclave], node.named["name"]
