# SPDX-License-Identifier: Apache-2.0
"""Images as they arrive, and the queue in which they wait."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pipeprog_frames.frame_decision import Load

MAX_QUEUE = 30  # frames of a camera that wait: one second of a fast one, thrice what a replay has on its way
MAX_QUEUE_BYTES = 1 << 28  # live; as many as the largest image has, 30 raw images of a 4 MP camera


@dataclass(frozen=True)
class Arrival:
    """One image, or the reason for which it cannot be used.

    Attributes:
        stamp: of the image [ns].
        frame_id: of the camera.
        size: width and height that its header declares [px].
        nbytes: what it occupies while it waits.
        encode: its JPEG or PNG bytes.
        load: decodes it, reduced and grey.
        refusal: why it cannot be used; empty: it can.
        camera: which of a rig's it is, by name; empty: there is one camera.
    """

    stamp: int
    frame_id: str
    size: tuple[int, int] = (0, 0)
    nbytes: int = 0
    encode: Callable[[], bytes] = bytes
    load: Load = lambda: None
    refusal: str = ""
    camera: str = ""


class ArrivalQueue:
    """Images that wait, in bounded memory; the oldest give way. A `lossless` one is bounded by their number alone."""

    def __init__(self, lossless: bool, most: int = MAX_QUEUE) -> None:
        self._lossless, self._most = lossless, most
        self._waiting: deque[Arrival] = deque()
        self._nbytes = 0

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def head(self) -> Arrival:
        """The oldest."""
        return self._waiting[0]

    def push(self, arrival: Arrival) -> list[Arrival]:
        """Adds an image; returns those that have no room beside it."""
        self._waiting.append(arrival)
        self._nbytes += arrival.nbytes
        dropped = []
        while len(self._waiting) > self._most or self._is_too_large():
            dropped.append(self.pop())
        return dropped

    def pop(self) -> Arrival:
        """Takes out the oldest."""
        arrival = self._waiting.popleft()
        self._nbytes -= arrival.nbytes
        return arrival

    def _is_too_large(self) -> bool:
        return not self._lossless and self._nbytes > MAX_QUEUE_BYTES and len(self._waiting) > 1
