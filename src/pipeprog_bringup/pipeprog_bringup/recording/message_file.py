# SPDX-License-Identifier: Apache-2.0
"""What a file of a recording gives, whatever its format: channels, counts, messages in the order of time, losses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from pipeprog_bringup.recording.ros1_messages import ENCODING as ROS1
from pipeprog_bringup.recording.ros1_messages import to_cdr


@dataclass(frozen=True)
class Channel:
    """A topic of the file: its message type, by its name in ROS 2, and how its messages are encoded."""

    topic: str
    type_name: str
    encoding: str


@dataclass(frozen=True)
class Message:
    """One message: log time [ns], channel number in its file, serialised data."""

    log_time: int
    channel_id: int
    data: bytes


class MessageFile(Protocol):
    """One file of a recording."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]  # messages of each channel

    def messages(self, channel_ids: set[int]) -> Iterator[Message]:
        """The messages of these channels in the order of their log times; raises InputError as the format says."""
        ...

    def losses(self) -> list[str]:
        """The parts that cannot be read, one sentence each; complete once the messages were read."""
        ...


def messages_of(files: tuple[MessageFile, ...], topics: set[str]) -> Iterator[Message]:
    """The messages on these topics of all files, in their order."""
    return (message for _, message in tagged_messages(files, topics))


def tagged_messages(files: tuple[MessageFile, ...], topics: set[str]) -> Iterator[tuple[str, Message]]:
    """As `messages_of`, each with its topic; messages of ROS 1 as those of ROS 2."""
    for file in files:
        wanted = {number: channel for number, channel in file.channels.items() if channel.topic in topics}
        for message in file.messages(set(wanted)):
            channel = wanted[message.channel_id]
            if channel.encoding == ROS1:
                message = replace(message, data=to_cdr(channel.type_name, message.data))
            yield channel.topic, message
