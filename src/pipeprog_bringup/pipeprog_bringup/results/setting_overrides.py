# SPDX-License-Identifier: Apache-2.0
"""Settings given as node.param=value on the command line, checked before any node starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_detect.config import DetectConfig
from pipeprog_frames.config import FramesConfig
from pipeprog_node.settings import build, describe, flatten, parse, unknown
from pipeprog_sfm.config import SfmConfig

NODE_CONFIGS: dict[str, type] = {"frames": FramesConfig, "sfm": SfmConfig, "detect": DetectConfig}


def effective(texts: Sequence[str], nodes: Sequence[str] = tuple(NODE_CONFIGS)) -> dict[str, Any]:
    """The configuration of each node, defaults overridden by `node.param=value` texts.

    Raises InputError for a text of another form, an unknown setting (naming the nearest one) or an unfit value.
    """
    settings = {f"{node}.{setting.name}": (node, setting) for node in nodes for setting in describe(NODE_CONFIGS[node])}
    values: dict[str, dict[str, Any]] = {node: {} for node in nodes}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write it as node.param=value, for example {next(iter(settings))}=...")
        if name.strip() not in settings:
            raise InputError(f"--set {text}: {unknown(name.strip(), settings)}")
        node, setting = settings[name.strip()]
        try:
            values[node][setting.name] = parse(value.strip(), setting)
        except InputError as error:
            raise InputError(f"--set {text}: {error}") from None
    return {node: build(NODE_CONFIGS[node], values[node]) for node in nodes}


def given_names(texts: Sequence[str]) -> set[str]:
    """The settings that `node.param=value` texts give."""
    return {text.partition("=")[0].strip() for text in texts}


def as_parameters(configs: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The configurations as flat parameter names and values per node."""
    return {node: flatten(config) for node, config in configs.items()}
