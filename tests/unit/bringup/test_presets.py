# SPDX-License-Identifier: Apache-2.0
"""Presets, the parameters page and the launch files agree with the settings and the packages."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeprog_bringup.parameters_doc import markdown
from pipeprog_bringup.results.setting_overrides import NODE_CONFIGS
from pipeprog_node.settings import build, flatten

ROOT = Path(__file__).parents[3]
BRINGUP = ROOT / "src" / "pipeprog_bringup"
PRESETS = sorted((BRINGUP / "config").glob("*.yaml"))
LAUNCH_FILES = sorted((BRINGUP / "launch").glob("*.launch.py"))


def preset(path: Path) -> dict[str, dict[str, Any]]:
    """Settings by node."""
    content = yaml.safe_load(path.read_text())
    return {name.removeprefix("/**/"): part["ros__parameters"] for name, part in content.items()}


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.name)
def test_presets_hold_settings_that_exist(path: Path) -> None:
    for node, values in preset(path).items():
        build(NODE_CONFIGS[node], values)


def test_default_preset_says_the_defaults() -> None:
    for node, values in preset(BRINGUP / "config" / "default.yaml").items():
        defaults = flatten(NODE_CONFIGS[node]())
        assert values == {name: defaults[name] for name in values}


def test_parameters_page_is_up_to_date() -> None:
    assert (ROOT / "docs" / "parameters.md").read_text() == markdown(), (
        "settings have changed: .venv/bin/python -m pipeprog_bringup.parameters_doc > docs/parameters.md"
    )


def calls(path: Path, name: str) -> list[ast.Call]:
    tree = ast.parse(path.read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == name]


def argument_name(call: ast.Call) -> str:
    assert isinstance(call.args[0], ast.Constant)
    return str(call.args[0].value)


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_arguments_are_declared_and_described(path: Path) -> None:
    declared = {}
    for call in calls(path, "DeclareLaunchArgument"):
        declared[argument_name(call)] = {keyword.arg for keyword in call.keywords}
    assert declared
    assert all("description" in keywords for keywords in declared.values())
    assert {name for name, keywords in declared.items() if "default_value" not in keywords} == {"boq"}
    used = [call for call in calls(path, "LaunchConfiguration") if isinstance(call.args[0], ast.Constant)]
    assert {argument_name(call) for call in used} <= set(declared)


def test_launched_executables_are_those_of_the_packages() -> None:
    launched = [argument_name(call) for call in calls(BRINGUP / "launch" / "pipeprog.launch.py", "pipeprog_node")]
    assert sorted(launched) == sorted(NODE_CONFIGS)
    for name in launched:
        assert f'"{name}_node = pipeprog_{name}.node:main"' in (ROOT / f"src/pipeprog_{name}/setup.py").read_text()


def test_the_launch_file_gives_each_parameter_of_the_node_survey() -> None:
    launch = BRINGUP / "launch" / "pipeprog.launch.py"
    (function,) = [
        node
        for node in ast.walk(ast.parse(launch.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name == "survey_node"
    ]
    given = {node.value for node in ast.walk(function) if isinstance(node, ast.Constant)}
    declared = calls(BRINGUP / "pipeprog_bringup" / "survey" / "node.py", "declare_fixed")
    parameters = {ast.literal_eval(call.args[1]) for call in declared}
    assert "record" in parameters
    assert parameters <= given
    assert parameters <= {argument_name(call) for call in calls(launch, "DeclareLaunchArgument")}
