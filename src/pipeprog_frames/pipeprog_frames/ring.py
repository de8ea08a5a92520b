"""A memory-bounded store of the compressed frames that may still become keyframes."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

from pipeprog_camera.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One image as it came: stamp [ns], frame of the camera, JPEG or PNG bytes, calibration."""

    stamp: int
    frame_id: str
    encoded: bytes
    camera: Camera


class FrameRing:
    """Frames by stamp; the oldest go when their bytes exceed `capacity`."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._frames: dict[int, Frame] = {}
        self._bytes = 0

    def add(self, frame: Frame) -> None:
        """Stores a frame whose stamp is later than all others."""
        self._frames[frame.stamp] = frame
        self._bytes += len(frame.encoded)
        while self._bytes > self._capacity and len(self._frames) > 1:
            oldest = next(iter(self._frames))
            self._bytes -= len(self._frames.pop(oldest).encoded)

    def get(self, stamp: int) -> Frame | None:
        """The frame, if it is still held."""
        return self._frames.get(stamp)

    def middle(self, after: int, before: int) -> Frame | None:
        """The held frame nearest to the middle of the open interval, or None when it is empty."""
        stamps = list(self._frames)
        inside = stamps[bisect_left(stamps, after + 1) : bisect_left(stamps, before)]
        if not inside:
            return None
        return self._frames[min(inside, key=lambda stamp: abs(2 * stamp - after - before))]
