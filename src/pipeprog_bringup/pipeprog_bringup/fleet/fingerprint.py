# SPDX-License-Identifier: Apache-2.0
"""What results are of: by the content of the input, and by what a listing tells of it without reading."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeprog_bringup.fleet.storage import Mark
from pipeprog_bringup.fleet.task import Task
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import parse_json

_BLOCK = 1 << 20  # bytes read at once


def mark(task: Task) -> str:
    """Of the input as it is listed: names, sizes and stamps of the files, contents of bill and boards, settings."""
    return _hash({name: [one.size, one.stamp] for name, one in task.recording.files.items()}, task)


def digest(task: Task, recording: Path) -> str:
    """Of the input's content; `recording` is the file or folder that has come."""
    return _hash({file.relative_to(recording.parent).as_posix(): _sha256(file) for file in _files(recording)}, task)


def state(recording: Path) -> dict[str, tuple[int, int]]:
    """Size and time of change [ns] of each file: another one means that somebody has written to it."""
    return {str(file): (file.stat().st_size, file.stat().st_mtime_ns) for file in _files(recording)}


def parsed(content: bytes) -> dict[str, Any]:
    """A run.json with the entry of a fleet under `fleet`; empty for anything else, such as half a file."""
    try:
        run = parse_json(content.decode(errors="replace"), "run.json")
    except InputError:
        return {}
    return run if isinstance(run.get("fleet"), dict) and isinstance(run["fleet"].get("sizes"), dict) else {}


def is_whole(run: Mapping[str, Any], files: Mapping[str, Mark]) -> bool:
    """Whether every file that a run.json lists is there with its size."""
    sizes: dict[str, int] = run["fleet"]["sizes"]
    return all(name in files and files[name].size == size for name, size in sizes.items())


def _files(recording: Path) -> list[Path]:
    return sorted(file for file in recording.rglob("*") if file.is_file()) if recording.is_dir() else [recording]


def _hash(files: Mapping[str, Any], task: Task) -> str:
    inputs = task.recording.inputs
    content = {
        "files": files,
        "boq": hashlib.sha256(task.boq).hexdigest(),
        "board": hashlib.sha256(task.board).hexdigest(),
        "settings": inputs.settings,
        "topics": dict(inputs.topics),
        "version": task.version,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sha256(file: Path) -> str:
    total = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK):
            total.update(block)
    return total.hexdigest()
