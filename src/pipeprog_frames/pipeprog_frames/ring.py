"""Stores of the compressed frames that may still become keyframes: bounded memory live, a file in a replay."""

from __future__ import annotations

import tempfile
from bisect import bisect_left
from collections.abc import Collection
from dataclasses import dataclass, replace

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_frames.decoding import GrayImage, decode_reduced
from pipeprog_frames.tracker import MIN_CORNERS, corners, sharpness

CHOICE = 3  # frames nearest to the middle, of which the sharpest is taken: a step blurs one, not its neighbours


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
        """Stores a frame whose stamp is later than all others; others are refused."""
        if self._frames and frame.stamp <= next(reversed(self._frames)):
            return
        self._frames[frame.stamp] = frame
        self._bytes += len(frame.encoded)
        while self._bytes > self._capacity and len(self._frames) > 1:
            oldest = next(iter(self._frames))
            self._bytes -= len(self._frames.pop(oldest).encoded)

    def get(self, stamp: int) -> Frame | None:
        """The frame, if it is still held."""
        return self._frames.get(stamp)

    def look(self, stamp: int) -> GrayImage | None:
        """The frame, reduced and grey; None when it is gone, damaged or shows too little to be a keyframe."""
        frame = self.get(stamp)
        gray = decode_reduced(frame.encoded, frame.camera.width) if frame else None
        return gray if gray is not None and len(corners(gray)) >= MIN_CORNERS else None

    def middle(self, after: int, before: int, without: Collection[int] = ()) -> int | None:
        """The stamp of the sharpest usable frame about the middle of the open interval, None when there is none."""
        stamps = list(self._frames)
        inside = [
            stamp
            for stamp in stamps[bisect_left(stamps, after + 1) : bisect_left(stamps, before)]
            if stamp not in without
        ]
        sharp: dict[int, float] = {}
        for stamp in sorted(inside, key=lambda stamp: (abs(2 * stamp - after - before), stamp)):
            gray = self.look(stamp)
            if gray is not None:
                sharp[stamp] = sharpness(gray)
            if len(sharp) == CHOICE:
                break
        return max(sharp, key=lambda stamp: sharp[stamp], default=None)


class FrameFile(FrameRing):
    """Every frame of a recording; their bytes lie in a file that is gone with the process."""

    def __init__(self) -> None:
        super().__init__(0)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the node lives
        self._places: dict[int, tuple[int, int]] = {}
        self._end = 0

    def add(self, frame: Frame) -> None:
        """Stores a frame whose stamp is later than all others; others are refused. Raises InputError on a full disk."""
        if frame.stamp in self._places:
            return
        super().add(replace(frame, encoded=b""))
        self._file.seek(self._end)
        try:
            self._file.write(frame.encoded)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"the recording's images do not fit into a file in {tempfile.gettempdir()} ({error.strerror}): "
                "make room there, or let TMPDIR name a folder that has it"
            ) from None
        self._places[frame.stamp] = self._end, len(frame.encoded)
        self._end += len(frame.encoded)

    def get(self, stamp: int) -> Frame | None:
        """The frame, if there is one of this stamp."""
        frame = self._frames.get(stamp)
        if frame is None:
            return None
        place, size = self._places[stamp]
        self._file.seek(place)
        return replace(frame, encoded=self._file.read(size))
