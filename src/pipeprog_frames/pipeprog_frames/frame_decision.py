# SPDX-License-Identifier: Apache-2.0
"""The decision on a frame, and the frame while none has been made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from pipeprog_frames.incoming.decoding import GrayImage
from pipeprog_frames.tracker import Track

NAN = float("nan")
DAMAGED = "damaged image"
UNCALIBRATED = "calibration: no usable CameraInfo has come"
FOREIGN = "calibration: the camera is none of the rig's"
OTHER_SIZE = "size differs from CameraInfo"
FULL = "max_keyframes reached: the map holds as many keyframes as it may"
FAULTS = (
    "damaged",
    "stamp",
    "size",
    "calibration",
    "video",
    "max_keyframes",
)  # beginnings of reasons that are faults of the images themselves, or of a limit: their frames are lost to the map
UNMATCHED = "shows nothing of the frames before and after it"
JUMP = "shows nothing of the frames before it"

Load = Callable[[], GrayImage | None]  # decodes a frame, reduced and grey; None where it is damaged


@dataclass(frozen=True)
class Decision:
    """Whether a frame is a keyframe, with the reason; fields as in pipeprog_msgs/FrameDecision.

    Attributes:
        stamp: of the frame [ns].
        chosen: whether it is a keyframe.
        reason: for people.
        overlap: with the last keyframe, 0 to 1; NaN: not measured.
        parallax: median against the last keyframe, px of the full image; NaN: not measured.
        sharpness: mean squared Laplacian of the reduced image; NaN: not measured.
        frame_id: of its camera in a rig; empty: of the one camera.
    """

    stamp: int
    chosen: bool
    reason: str
    overlap: float = NAN
    parallax: float = NAN
    sharpness: float = NAN
    frame_id: str = ""


@dataclass
class Candidate:
    """A frame that is still undecided: its stamp [ns], what decodes it, and what was measured of it."""

    stamp: int
    load: Load
    track: Track = field(default_factory=lambda: Track(NAN, NAN, 0))
    sharpness: float = NAN
    _gray: GrayImage | None = None

    @property
    def gray(self) -> GrayImage | None:
        """The image, decoded once."""
        if self._gray is None:
            self._gray = self.load()
        return self._gray

    def decided(self, chosen: bool, reason: str) -> Decision:
        """The decision on it."""
        return Decision(self.stamp, chosen, reason, self.track.overlap, self.track.parallax, self.sharpness)
