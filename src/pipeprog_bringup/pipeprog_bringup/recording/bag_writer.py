# SPDX-License-Identifier: Apache-2.0
"""Writes recordings: an mcap file of the ROS 2 profile that rosbag2 and Foxglove open."""

from __future__ import annotations

from types import TracebackType
from typing import BinaryIO

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from pipeprog_bringup.recording.definitions import message_definition


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
