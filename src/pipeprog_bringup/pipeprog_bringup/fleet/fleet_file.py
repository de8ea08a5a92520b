# SPDX-License-Identifier: Apache-2.0
"""fleet.yaml: recordings with bill, boards, settings and reference of each."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from pipeprog_bringup.fleet.recordings import Inputs, Recording, listed
from pipeprog_bringup.results.setting_overrides import effective
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.outside_text import name_of, nearest, shown

_TOPICS = ("image_topic", "camera_info_topic", "odometry_topic", "imu_topic")
_SHARED = ("boq", "board", "settings", *_TOPICS)
_OWN = ("path", "name", "reference", *_SHARED)


def is_fleet_file(address: str) -> bool:
    """Whether an argument names a fleet.yaml and no recording."""
    return address.lower().endswith((".yaml", ".yml"))


def read_fleet_file(path: Path, inputs: Inputs) -> list[Recording]:
    """The recordings of a fleet.yaml; `inputs` hold where the file says nothing else.

    Raises InputError, naming the file, the line and the remedy, for what is no such file; StorageFailure where a
    storage that it names does not answer.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no mapping: a fleet file begins with 'recordings:'")
    _refuse_unknown(str(path), content, ("recordings", *_SHARED))
    entries = content.get("recordings")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}{line_of(content, 'recordings')}: recordings is {shown(entries)}: list at least one")
    shared = _inputs(f"{path}", path.parent, content, inputs)
    found: list[Recording] = []
    for number, entry in enumerate(entries):
        where = f"{path}{line_of(entries, number)}"
        if not isinstance(entry, dict):
            entry = {"path": entry}
        _refuse_unknown(where, entry, _OWN)
        address = _address(where, path.parent, entry, "path")
        name = name_of(entry["name"], f"{where}: name") if "name" in entry else ""
        found += listed(address, _inputs(where, path.parent, entry, shared), name)
    return found


def _inputs(where: str, folder: Path, content: dict[str, Any], default: Inputs) -> Inputs:
    """`default` with what the mapping says; settings come after those of the default, and so win."""
    changed: dict[str, Any] = {key: _address(where, folder, content, key) for key in ("boq", "board") if key in content}
    if "settings" in content:
        changed["settings"] = (*default.settings, *_settings(where, content["settings"]))
    if "reference" in content:
        changed["reference"] = name_of(content["reference"], f"{where}: reference")
    topics = {key: name_of(content[key], f"{where}: {key}") for key in _TOPICS if key in content}
    return dataclasses.replace(default, **changed, topics={**default.topics, **topics})


def _address(where: str, folder: Path, content: dict[str, Any], key: str) -> str:
    """A path, which is relative to the file's folder, or an address with a protocol."""
    text = name_of(content.get(key), f"{where}: {key}")
    return text if "://" in text else str(folder / text)


def _settings(where: str, content: Any) -> list[str]:
    """`{node.param: value}` as texts; raises InputError for an unknown setting or an unfit value."""
    if not isinstance(content, dict):
        raise InputError(f"{where}: settings is {shown(content)}: write node.param: value, one a line")
    texts = [f"{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in content.items()]
    try:
        effective(texts)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return texts


def _refuse_unknown(where: str, content: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            raise InputError(f"{where}: unknown key {shown(key)}: did you mean '{nearest(key, known)}'?")
