# SPDX-License-Identifier: Apache-2.0
"""What pipeprog.launch.py describes, with the packages `launch` and `launch_ros` replaced: no wheel has them."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

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


def described() -> list[Made]:
    """The arguments and nodes of the launch file."""
    with mock.patch.dict(sys.modules, {name: Recorder(name) for name in MODULES}):
        description = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()
    return list(description.arguments[0])
