# SPDX-License-Identifier: Apache-2.0
"""A recording read as a replay reads it, up to the doors of the nodes: each message that is sent must pass them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.player import Player, calibration
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_node import messages
from pipeprog_node.received import images as received_images

_DOORS: dict[Any, Callable[[Any], Any]] = {
    CompressedImage: received_images.compressed_image,
    Image: received_images.raw_image,
    CameraInfo: received_images.camera_info,
}


@dataclass(frozen=True)
class Reading:
    """What a recording gave: frames that were sent, and what the user is told was lost."""

    sent: int
    losses: list[str]


class _Publisher:
    """Takes messages as a node would; raises what its middleware or its door would."""

    def __init__(self, msg_type: Any, log: FrameLog) -> None:
        self.msg_type, self._log = msg_type, log

    def publish(self, message: Any) -> None:
        content = message if isinstance(message, bytes) else serialize_message(message)
        decoded = deserialize_message(content, self.msg_type)
        if self.msg_type in _DOORS:
            _DOORS[self.msg_type](decoded)
        if self.msg_type in (Image, CompressedImage):
            self._log.decide(FrameRow(messages.stamp_ns(decoded.header.stamp), True, "sent"))

    def wait_for_all_acked(self) -> None:
        """All were taken at once."""


class Doors:
    """Stands for the node that the player publishes with: each message must pass the door of the node that takes it."""

    def __init__(self, log: FrameLog) -> None:
        self._log = log

    def create_publisher(self, msg_type: Any, topic: str, profile: object) -> _Publisher:
        return _Publisher(msg_type, self._log)


def read(path: Path) -> Reading:
    """Play the recording into doors alone, then pass over it again, as for out.mcap; raises what a replay would."""
    bag = Bag.open(path)
    log = FrameLog()
    player = Player(Doors(log), bag, log)
    sent = player.play(None, lambda seconds: None, lambda due: None)
    assert not log.in_flight, "each frame that was sent has its decision"
    for frame in bag:
        if not frame.fault:
            calibration(frame)
    return Reading(sent, bag.losses + log.faults())
