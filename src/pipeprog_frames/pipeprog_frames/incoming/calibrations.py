# SPDX-License-Identifier: Apache-2.0
"""Which calibration belongs to an image."""

from __future__ import annotations

from collections import OrderedDict

from pipeprog_camera.camera import Camera

MAX_STAMPS = 1000  # calibrations that are remembered by their stamps: 30 s of a fast camera
MAX_SIZES = 16  # sizes of which the last calibration is remembered: more than a camera has modes


class Calibrations:
    """Calibrations by the stamps of their images, and the last one of each size.

    An image has the calibration of its stamp. Where there is none, it has the last one of its size, since not every
    driver stamps its calibrations; not so where each image is `paired` with one, as a replay sends them.
    """

    def __init__(self, paired: bool) -> None:
        self._paired = paired
        self._by_stamp: OrderedDict[int, Camera | None] = OrderedDict()
        self._by_size: OrderedDict[tuple[int, int], Camera] = OrderedDict()
        self._newest: Camera | None = None

    @property
    def newest(self) -> Camera | None:
        """The last one that came."""
        return self._newest

    def add(self, stamp: int, camera: Camera | None) -> None:
        """Notes a calibration; None: it came and cannot be used, so that the one before it stays in force."""
        if camera is not None:
            self._newest = camera
            self._by_size[camera.width, camera.height] = camera
            self._by_size.move_to_end((camera.width, camera.height))
        self._by_stamp[stamp] = self._newest
        for held, limit in ((self._by_stamp, MAX_STAMPS), (self._by_size, MAX_SIZES)):
            while len(held) > limit:
                held.popitem(last=False)

    def is_known(self, stamp: int, size: tuple[int, int]) -> bool:
        """Whether the calibration of an image has come."""
        return stamp in self._by_stamp or (not self._paired and size in self._by_size)

    def of(self, stamp: int, size: tuple[int, int]) -> Camera | None:
        """The calibration of an image; None where no usable one has come."""
        if stamp in self._by_stamp:
            return self._by_stamp[stamp]
        return self._by_size.get(size, self._newest)
