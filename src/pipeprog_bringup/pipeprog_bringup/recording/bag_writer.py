# SPDX-License-Identifier: Apache-2.0
"""Writes recordings: an mcap file of the ROS 2 profile that rosbag2 and Foxglove open."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import BinaryIO

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from pipeprog_bringup.recording.definitions import message_definition

# How rosbag2 notes the quality of service of a topic (the numbers are those of rmw, which all its versions read), so
# that `ros2 bag play` offers a map to those who subscribe after it was played.
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_QOS = (
    "- {{history: 1, depth: 1, reliability: 1, durability: {durability}, deadline: {forever}, lifespan: {forever}, "
    "liveliness: 1, liveliness_lease_duration: {forever}, avoid_ros_namespace_conventions: false}}"
)
_TRANSIENT_LOCAL, _VOLATILE = 1, 2


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

    def describe(self, facts: Mapping[str, str]) -> None:
        """Add a metadata record `pipeprog` that says what the recording is."""
        self._writer.add_metadata("pipeprog", dict(facts))

    def write(self, topic: str, type_name: str, data: bytes, stamp: int, latched: bool = False) -> None:
        """Add one message of CDR bytes, logged and published at `stamp` [ns].

        A topic is latched, as its first message says, where the last message is for late subscribers, too.
        """
        if topic not in self._channels:
            if type_name not in self._schemas:
                definition = message_definition(type_name).encode()
                self._schemas[type_name] = self._writer.register_schema(type_name, SchemaEncoding.ROS2, definition)
            durability = _TRANSIENT_LOCAL if latched else _VOLATILE
            offered = {"offered_qos_profiles": _QOS.format(durability=durability, forever=_FOREVER)}
            schema = self._schemas[type_name]
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.CDR, schema, offered)
        self._writer.add_message(self._channels[topic], stamp, data, stamp)
