# SPDX-License-Identifier: Apache-2.0
"""Message definitions in the form that recordings carry, from the .msg files of the ROS installation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pipeprog_camera.errors import InputError

_PRIMITIVES = frozenset(
    ["bool", "byte", "char", "string", "wstring", "float32", "float64"]
    + [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
)


def message_definition(type_name: str) -> str:
    """The definition of `package/msg/Name` followed by those it uses, as mcap's ros2msg encoding wants them."""
    package, _, name = type_name.split("/")
    top = _definition_text(package, name)
    parts, found, pending = [top], {(package, name)}, [(package, top)]
    while pending:
        package, text = pending.pop(0)
        for used in _used_types(package, text):
            if used not in found:
                found.add(used)
                definition = _definition_text(*used)
                parts.append(f"MSG: {used[0]}/{used[1]}\n{definition}")
                pending.append((used[0], definition))
    return ("\n" + "=" * 80 + "\n").join(parts)


def _definition_text(package: str, name: str) -> str:
    roots = [Path(root) for root in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if root]
    for root in [*roots, Path(sys.prefix)]:
        file = root / "share" / package / "msg" / f"{name}.msg"
        if file.is_file():
            return file.read_text()
    raise InputError(
        f"definition of {package}/msg/{name} not found: set up ROS 2 first (`make setup`, or source its setup.bash)"
    )


def _used_types(package: str, text: str) -> list[tuple[str, str]]:
    """Package and name of the messages that a definition's fields have as their types."""
    used = []
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if len(words) < 2:
            continue
        kind = words[0].split("[")[0].split("<")[0]
        if kind not in _PRIMITIVES:
            owner, _, name = kind.rpartition("/")
            used.append((owner.removesuffix("/msg") or package, name))
    return used
