# SPDX-License-Identifier: Apache-2.0
"""docs/parameters.md from the settings dataclasses.

python -m pipeprog_bringup.parameters_doc > docs/parameters.md
"""

from __future__ import annotations

import sys

from pipeprog_bringup.results.setting_overrides import NODE_CONFIGS
from pipeprog_node.settings import Setting, describe

_HEAD = """\
# Parameters

Generated from the dataclasses in the `config.py` of each package; do not edit.
After a change there: `.venv/bin/python -m pipeprog_bringup.parameters_doc > docs/parameters.md`

On the command line a setting is `--set NODE.NAME=VALUE`.
As a ROS parameter it is the read-only parameter `NAME` of the node `NODE`.
`src/pipeprog_bringup/config/default.yaml` shows a file of parameters.
An unknown name is an error that gives the nearest known one.
"""


def markdown() -> str:
    """The whole page."""
    return "\n".join([_HEAD, *(_section(node, describe(config)) for node, config in NODE_CONFIGS.items())])


def _section(node: str, settings: list[Setting]) -> str:
    rows = [f"## {node}", "", "| name | default | unit | allowed | what |", "|---|---|---|---|---|"]
    rows += [
        f"| `{one.name}` | {_value(one.default)} | {one.unit} | {_allowed(one)} | {one.description} |"
        for one in settings
    ]
    return "\n".join(rows) + "\n"


def _allowed(setting: Setting) -> str:
    allowed = f"a {setting.type.__name__}" if setting.type is not bool else "true, false"
    if setting.choices is not None:
        allowed = ", ".join(_value(choice) for choice in setting.choices)
    elif setting.range is not None:
        low, high = setting.range
        allowed = f"{low} to {high}"
    return allowed + (" or none" if setting.optional else "")


def _value(value: object) -> str:
    if value is None:
        return "none"
    return str(value).lower() if isinstance(value, bool) else str(value)


if __name__ == "__main__":
    sys.stdout.write(markdown())
