# SPDX-License-Identifier: Apache-2.0
"""Which calibration an image gets: that of its stamp, or else the last of its size."""

from __future__ import annotations

from pipeprog_camera.camera import Camera
from pipeprog_frames.incoming.calibrations import MAX_SIZES, MAX_STAMPS, Calibrations

WIDE = Camera(640, 480, 300.0, 300.0, 319.5, 239.5)
ZOOMED = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
SMALL = Camera(320, 240, 150.0, 150.0, 159.5, 119.5)


def test_an_image_has_the_calibration_of_its_stamp() -> None:
    calibrations = Calibrations(paired=True)
    for stamp, camera in ((1, WIDE), (2, SMALL), (3, ZOOMED)):
        calibrations.add(stamp, camera)
    assert [calibrations.of(stamp, (640, 480)) for stamp in (1, 2, 3)] == [WIDE, SMALL, ZOOMED]


def test_in_a_replay_an_image_waits_for_its_calibration() -> None:
    calibrations = Calibrations(paired=True)
    calibrations.add(1, WIDE)
    assert calibrations.is_known(1, (640, 480))
    assert not calibrations.is_known(2, (640, 480))
    calibrations.add(2, None)  # it came and was refused: the one before it stays in force, not a later one
    calibrations.add(3, ZOOMED)
    assert calibrations.is_known(2, (640, 480))
    assert calibrations.of(2, (640, 480)) == WIDE


def test_live_the_last_calibration_of_its_size_does() -> None:
    calibrations = Calibrations(paired=False)
    assert not calibrations.is_known(5, (640, 480))
    assert calibrations.of(5, (640, 480)) is None
    calibrations.add(0, WIDE)
    calibrations.add(1, SMALL)
    assert calibrations.is_known(5, (640, 480))
    assert not calibrations.is_known(5, (32, 32))
    assert calibrations.of(5, (640, 480)) == WIDE
    assert calibrations.of(5, (32, 32)) == SMALL


def test_memory_is_bounded() -> None:
    calibrations = Calibrations(paired=False)
    for stamp in range(20_000):
        calibrations.add(stamp, Camera(100 + stamp, 100, 100.0, 100.0, 50.0, 50.0))
    assert len(calibrations._by_stamp) == MAX_STAMPS
    assert len(calibrations._by_size) == MAX_SIZES
