"""Writes recordings: an mcap file of the ROS 2 profile that rosbag2 and Foxglove open."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from pipeprog_camera.errors import InputError

_PRIMITIVES = frozenset(
    ["bool", "byte", "char", "string", "wstring", "float32", "float64"]
    + [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
)


class BagWriter:
    """Writes serialised messages to a binary stream; closes the recording, not the stream, on exit."""

    def __init__(self, stream: BinaryIO) -> None:
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="pipeprog")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()

    def write(self, topic: str, type_name: str, data: bytes, stamp: int) -> None:
        """Add one message of CDR bytes, logged and published at `stamp` [ns]."""
        if topic not in self._channels:
            if type_name not in self._schemas:
                definition = message_definition(type_name).encode()
                self._schemas[type_name] = self._writer.register_schema(type_name, SchemaEncoding.ROS2, definition)
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.CDR, self._schemas[type_name])
        self._writer.add_message(self._channels[topic], stamp, data, stamp)


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
