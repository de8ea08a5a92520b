# SPDX-License-Identifier: Apache-2.0
"""The files of a recording: one file, or those of a rosbag2 folder, as its metadata.yaml or their names order them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.yaml_file import read_yaml
from pipeprog_camera.limits import MAX_BAG_PARTS, MAX_METADATA
from pipeprog_camera.outside_text import nearest, shown

_LISTED = 5  # names that an error lists
_SUFFIXES, _MOST_NAMES = (".mcap", ".db3", ".bag"), 1000  # of recordings beside one that is not there
_STORAGES = ("mcap", "sqlite3", "")  # an empty one is what a crash leaves (rosbag2#2175)
_NUMBERED = re.compile(r"(.+)_(\d{1,9})\.(mcap|db3)")  # the names that rosbag2 gives the files of one recording


def parts(path: Path) -> list[Path]:
    """The files of the recording `path`, in order; raises InputError where it is none or files are missing."""
    if not path.exists():
        raise InputError(f"no such bag: {path}: {_instead_of(path)}")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return _named_files(path, _information(path))
        return _numbered_files(path)
    if not path.is_file():
        raise InputError(f"{path} is a device or a pipe: give an .mcap or .db3 file or a rosbag2 folder")
    return [path]


def _instead_of(missing: Path) -> str:
    """What to give in place of a file that is not there."""
    if not missing.parent.is_dir():
        return f"there is no folder {missing.parent}, check the path"
    there = [each.name for each in missing.parent.iterdir() if each.suffix in _SUFFIXES][:_MOST_NAMES]
    return f"did you mean '{nearest(missing.name, there)}'?" if there else f"{missing.parent} holds no recording"


def _information(path: Path) -> dict[str, Any]:
    """What metadata.yaml says of the recording's storage."""
    metadata = path / "metadata.yaml"
    remedy = f"run `ros2 bag reindex {path}`"
    try:
        content = read_yaml(metadata, MAX_METADATA)
    except InputError as error:
        raise InputError(f"no rosbag2 metadata: {error}; {remedy}") from None
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict) or not isinstance(information.get("relative_file_paths"), list):
        raise InputError(f"{metadata} is no rosbag2 metadata (it has no relative_file_paths): {remedy}")
    return information


def _numbered_files(path: Path) -> list[Path]:
    """The files of a folder without metadata.yaml, which rosbag2 writes last: those of one name, by their numbers."""
    inside = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    numbered = {file: match for file in inside if file.is_file() and (match := _NUMBERED.fullmatch(file.name))}
    if not inside or len(numbered) < len(inside) or len({match[1] for match in numbered.values()}) > 1:
        names = _listed([file.name for file in inside])
        remedy = f"give one of its files ({names}) or run" if inside else "give a rosbag2 folder, or run"
        raise InputError(f"{path} has no metadata.yaml: {remedy} `ros2 bag reindex {path}`")
    if len(numbered) > MAX_BAG_PARTS:
        raise InputError(f"{path} holds {len(numbered)} files: {MAX_BAG_PARTS} at most are read; split the recording")
    return sorted(numbered, key=lambda file: int(numbered[file][2]))


def _named_files(path: Path, information: dict[str, Any]) -> list[Path]:
    """The files that the metadata names; all lie in the folder."""
    metadata = path / "metadata.yaml"
    storage = str(information.get("storage_identifier", "mcap"))[:40]
    if storage not in _STORAGES:
        raise InputError(f"{path} is stored as {shown(storage)}: convert it with `ros2 bag convert` (storage_id: mcap)")
    if str(information.get("compression_mode", ""))[:40].upper() == "FILE":
        raise InputError(f"{path} is compressed file by file: decompress it with `ros2 bag convert`")
    names = information["relative_file_paths"]
    if not names:
        raise InputError(f"{metadata} names no file: the recording is empty")
    if len(names) > MAX_BAG_PARTS:
        raise InputError(f"{metadata} names {len(names)} files: {MAX_BAG_PARTS} at most are read; split the recording")
    files = [_inside(path, name) for name in names]
    if len({*files}) < len(files):
        raise InputError(f"{metadata} names a file twice: run `ros2 bag reindex {path}`")
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{path}: {_listed(missing)} named in metadata.yaml is missing: copy the folder again")
    return files


def _inside(path: Path, name: Any) -> Path:
    """The file of that name in the folder; before Foxy the names were relative to the folder above."""
    if not isinstance(name, str) or not name.isprintable() or len(name) > 255 or ".." in Path(name).parts:
        raise InputError(
            f"{path / 'metadata.yaml'} names {shown(name)}, no file in its folder: run `ros2 bag reindex {path}`"
        )
    is_there = not Path(name).is_absolute() and (path / name).exists()
    return path / name if is_there else path / Path(name).name


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
