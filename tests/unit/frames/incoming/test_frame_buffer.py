# SPDX-License-Identifier: Apache-2.0
"""The frames that a selector may come back to: which are held, and which of them is the sharpest."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameFile, FrameRing, FrameStore

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
CAPACITY = 1 << 20  # bytes
TEXTURE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8), (0, 0), 1.5)
STORES = [lambda: FrameRing(CAPACITY), FrameFile]


def frame(stamp: int, blur: float = 0.0) -> EncodedFrame:
    image = cv2.GaussianBlur(TEXTURE, (0, 0), blur) if blur else TEXTURE
    return EncodedFrame(stamp, "camera", cv2.imencode(".png", image)[1].tobytes(), CAMERA)


@pytest.mark.parametrize("make", STORES)
def test_frames_come_back_as_they_were(make: Callable[[], FrameStore]) -> None:
    store, frames = make(), [frame(stamp, 0.5 * stamp) for stamp in (1, 2, 3)]
    for each in frames:
        store.add(each)
    store.add(frame(2, 5.0))  # not later than the last: refused
    assert [store.get(stamp) for stamp in (1, 2, 3)] == frames
    assert store.get(4) is None


@pytest.mark.parametrize("make", STORES)
def test_the_sharpest_frame_near_the_middle_is_taken(make: Callable[[], FrameStore]) -> None:
    store = make()
    for stamp, blur in ((0, 0.0), (10, 0.0), (20, 2.0), (30, 0.8), (40, 2.0), (50, 0.0), (60, 0.0)):
        store.add(frame(stamp, blur))
    assert store.sharpest_between(0, 60) == 30, "10 and 50 are sharper, but not among the three nearest to the middle"
    assert store.sharpest_between(0, 60, without=(20, 30, 40)) in (10, 50)
    assert store.sharpest_between(10, 30) == 20, "the ends are not between"
    assert store.sharpest_between(10, 20) is None


def test_a_full_ring_forgets_its_oldest_frames() -> None:
    size = len(frame(0).encoded)
    ring = FrameRing(int(3.5 * size))
    for stamp in range(8):
        ring.add(frame(stamp))
    assert [stamp for stamp in range(8) if ring.get(stamp) is not None] == [5, 6, 7]
    assert ring.get(7) == frame(7)
