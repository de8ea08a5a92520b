# SPDX-License-Identifier: Apache-2.0
"""Which frames are worth decoding: none while the motion so far says that no keyframe is due for long."""

from __future__ import annotations

from pipeprog_frames.policy.keyframe_limits import KeyframeLimits
from pipeprog_frames.tracker import Track

MAX_UNSEEN = 200_000_000  # ns between two looks: a turn of 90 degrees a second moves by 18, within the tracker's reach


class DecodeSchedule:
    """The time of the next look, by the speed at which the limits have been approached since the last keyframe."""

    def __init__(self, limits: KeyframeLimits) -> None:
        self._limits = limits
        self._speed = 0.0  # progress to the next keyframe per ns
        self._keyframe = 0  # stamp of the last one
        self.next_look = 0  # stamp before which frames need not be decoded

    def start(self, stamp: int) -> None:
        """Begins at the first keyframe; the next frame is looked at."""
        self._keyframe = self.next_look = stamp

    def look_again(self, stamp: int) -> None:
        """Has the frame after `stamp` looked at."""
        self.next_look = stamp

    def looked(self, stamp: int, track: Track) -> None:
        """Sets the next look half-way to where the next keyframe would be due at the speed so far."""
        progress = self._limits.progress(track)
        self._speed = progress / (stamp - self._keyframe)
        self.next_look = stamp + self._wait(progress)

    def chosen(self, stamp: int, track: Track) -> None:
        """Begins anew at a keyframe, with the speed at which it was reached."""
        self._speed = self._limits.progress(track) / (stamp - self._keyframe)
        self._keyframe = stamp
        self.next_look = stamp + self._wait(0.0)

    def _wait(self, progress: float) -> int:
        """ns"""
        return int(min(0.5 * max(1.0 - progress, 0.0) / max(self._speed, 1e-12), MAX_UNSEEN))
