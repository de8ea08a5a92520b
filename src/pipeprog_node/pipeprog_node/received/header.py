# SPDX-License-Identifier: Apache-2.0
"""Headers of messages from outside, checked: stamp and frame, or InvalidMessageError."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from pipeprog_camera.limits import MAX_NAME, MAX_SECONDS
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError


def stamp_and_frame(header: Header) -> tuple[int, str]:
    """Stamp [ns], zero or later, and name of the frame."""
    if len(header.frame_id) > MAX_NAME:
        raise InvalidMessageError("name", f"a frame_id of {len(header.frame_id)} characters is no name of a frame")
    return checked_stamp(header.stamp), header.frame_id


def checked_stamp(stamp: Time) -> int:
    """Nanoseconds of a stamp, zero or later; before the last second, so that a nanosecond can still be added."""
    if not 0 <= stamp.sec < MAX_SECONDS or stamp.nanosec >= messages.SECOND:
        raise InvalidMessageError(
            "stamp", f"the stamp {stamp.sec} s + {stamp.nanosec} ns is no time: stamp the message"
        )
    return messages.stamp_ns(stamp)
