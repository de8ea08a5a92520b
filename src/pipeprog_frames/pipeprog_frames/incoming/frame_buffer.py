# SPDX-License-Identifier: Apache-2.0
"""Stores of the compressed frames that may still become keyframes: bounded memory live, a file in a replay."""

from __future__ import annotations

import mmap
import tempfile
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_frames.corners import corners, sharpness
from pipeprog_frames.incoming.decoding import GrayImage, decode_reduced
from pipeprog_frames.tracker import MIN_CORNERS

CHOICE = 3  # frames nearest to the middle, of which the sharpest is taken: a footstep blurs one, not all three


@dataclass(frozen=True)
class EncodedFrame:
    """One image as received: stamp [ns], frame of the camera, JPEG or PNG bytes, calibration."""

    stamp: int
    frame_id: str
    encoded: bytes
    camera: Camera


class FrameStore(ABC):
    """Frames by stamp."""

    def __init__(self) -> None:
        self._frames: dict[int, EncodedFrame] = {}  # without their bytes
        self._places: dict[int, tuple[int, int]] = {}  # of these: start, length

    @abstractmethod
    def _write(self, encoded: bytes) -> int:
        """Stores bytes and returns their start; forgets the frames whose bytes it overwrites."""

    @abstractmethod
    def _read(self, start: int, size: int) -> bytes:
        """The `size` bytes stored from `start` on."""

    def add(self, frame: EncodedFrame) -> None:
        """Stores a frame whose stamp is later than all others; others are refused. Raises InputError on a full disk."""
        if self._frames and frame.stamp <= next(reversed(self._frames)):
            return
        start = self._write(frame.encoded)
        self._frames[frame.stamp] = replace(frame, encoded=b"")
        self._places[frame.stamp] = start, len(frame.encoded)

    def forget_from(self, stamp: int) -> None:
        """Forgets the frames of this stamp and later: the clock was set back, and frames of these stamps may come."""
        while self._frames and (last := next(reversed(self._frames))) >= stamp:
            del self._frames[last], self._places[last]

    def get(self, stamp: int) -> EncodedFrame | None:
        """The frame, if it is still held."""
        frame = self._frames.get(stamp)
        return replace(frame, encoded=self._read(*self._places[stamp])) if frame is not None else None

    def reduced(self, stamp: int) -> GrayImage | None:
        """The frame, reduced and grey; None where it is gone, damaged or has too few corners for a keyframe."""
        frame = self.get(stamp)
        gray = decode_reduced(frame.encoded, frame.camera.width) if frame else None
        return gray if gray is not None and len(corners(gray)) >= MIN_CORNERS else None

    def sharpest_between(self, after: int, before: int, without: Collection[int] = ()) -> int | None:
        """Stamp of the sharpest usable frame near the middle of an open interval; None where there is none.

        Args:
            after: start of the interval [ns].
            before: end of the interval [ns].
            without: stamps that are not to be taken.
        """
        stamps = list(self._frames)
        inside = [
            stamp
            for stamp in stamps[bisect_left(stamps, after + 1) : bisect_left(stamps, before)]
            if stamp not in without
        ]
        sharp: dict[int, float] = {}
        for stamp in sorted(inside, key=lambda stamp: (abs(2 * stamp - after - before), stamp)):
            gray = self.reduced(stamp)
            if gray is not None:
                sharp[stamp] = sharpness(gray)
            if len(sharp) == CHOICE:
                break
        return max(sharp, key=lambda stamp: sharp[stamp], default=None)


class FrameRing(FrameStore):
    """The latest frames, in `capacity` bytes of memory; the oldest are overwritten.

    It is one block of memory, since allocating and freeing blocks of all sizes would fragment the heap.
    """

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self._memory = mmap.mmap(-1, capacity)  # the system provides its pages as they are first written
        self._end = 0

    def _write(self, encoded: bytes) -> int:
        size = len(encoded)
        if size > len(self._memory):  # a frame larger than all of it is held alone
            self._forget(lambda start, end: True)
            self._memory.close()
            self._memory, self._end = mmap.mmap(-1, size), 0
        if self._end + size > len(self._memory):
            behind = self._end
            self._forget(lambda start, end: start >= behind)
            self._end = 0
        begin, self._end = self._end, self._end + size
        self._forget(lambda start, end: start < begin + size and end > begin)
        self._memory[begin : begin + size] = encoded
        return begin

    def _forget(self, overlaps: Callable[[int, int], bool]) -> None:
        """Forgets the oldest frames for as long as `overlaps(start, end)` of their bytes."""
        while self._frames:
            oldest = next(iter(self._frames))
            start, size = self._places[oldest]
            if not overlaps(start, start + size):
                return
            del self._frames[oldest], self._places[oldest]

    def _read(self, start: int, size: int) -> bytes:
        return self._memory[start : start + size]


class FrameFile(FrameStore):
    """Every frame of a recording; their bytes are in a temporary file that ends with the process."""

    def __init__(self) -> None:
        super().__init__()
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the node lives
        self._end = 0

    def _write(self, encoded: bytes) -> int:
        start = self._end
        self._file.seek(start)
        try:
            self._file.write(encoded)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"the recording's images do not fit into a file in {tempfile.gettempdir()} ({error.strerror} after "
                f"{start / 1e6:.0f} MB): make room there, or let TMPDIR name a folder that has it"
            ) from None
        self._end += len(encoded)
        return start

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)
