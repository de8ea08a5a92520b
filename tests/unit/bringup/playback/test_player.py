# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import pytest

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.player import MAX_GAP, Player
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_camera.errors import InputError
from tests.fuzz.bag_reading import Doors, read
from tests.fuzz.hostile_bags import cases

CASES = cases()


def written(folder: Path, name: str) -> Path:
    return CASES[name].write(folder / "bag.mcap")


def test_a_change_of_resolution_with_its_calibration_is_sent(tmp_path: Path) -> None:
    reading = read(written(tmp_path, "resolutions: changed with its CameraInfo"))
    assert (reading.sent, reading.losses) == (8, [])


def test_a_change_of_resolution_without_its_calibration_is_told_with_its_frame(tmp_path: Path) -> None:
    reading = read(written(tmp_path, "resolutions: changed without its CameraInfo"))
    assert reading.losses == [
        "4 frames left out: size does not fit: the image is 128 x 96, but /camera/camera_info is calibrated for "
        "64 x 48: record the CameraInfo of this camera mode (frame 5, the first of them)"
    ]


def test_stamps_that_are_no_time_are_told_at_the_start_or_left_out(tmp_path: Path) -> None:
    path = written(tmp_path, "times: all stamps of 2147483647 s + 999999999 ns")
    with pytest.raises(InputError, match=r"none of the 8 images .* stamp is no time: 2147483647 s"):
        Bag.open(path)
    reading = read(written(tmp_path, "times: one stamp of -1 s + 0 ns"))
    assert reading.sent == 7
    assert reading.losses[0].startswith("1 frames left out: stamp is no time: -1 s + 0 ns")


def test_a_calibration_cut_behind_its_matrix_is_left_out(tmp_path: Path) -> None:
    for case in (name for name in CASES if name.startswith("calibrations: cut after")):
        reading = read(written(tmp_path, case))
        assert reading.sent == 8
        assert reading.losses == ["1 messages on /camera/camera_info left out: damaged"], case


def test_no_pixel_is_decoded_for_the_size_of_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(InputError, match="an image is too large"):
        read(written(tmp_path, "pictures: only JPEG of 30000 x 30000"))
    reading = read(written(tmp_path, "pictures: one JPEG of 3000 scans"))
    assert reading.sent == 7
    assert "scans: 100 at most" in reading.losses[0]


def test_damaged_motion_is_counted(tmp_path: Path) -> None:
    reading = read(written(tmp_path, "motions: Odometry cut in half"))
    assert reading.losses == ["1 messages of odometry left out: damaged"]
    reading = read(written(tmp_path, "motions: TFMessage with a tail of 2 MB"))
    assert reading.losses == ["1 messages of /tf left out: damaged"]


def test_a_rate_is_not_held_over_years(tmp_path: Path) -> None:
    bag = Bag.open(written(tmp_path, "times: stamps far apart"))
    log = FrameLog()
    dues: list[float] = []
    Player(Doors(log), bag, log).play(1.0, lambda seconds: None, dues.append)
    assert [round(later - due, 6) for due, later in pairwise(dues)] == [MAX_GAP] * 7


class Slow(FrameLog):
    """Decisions wait in `late` until they are asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.late: list[FrameRow] = []

    def decide(self, row: FrameRow) -> None:
        self.late.append(row)

    def decide_one(self) -> None:
        super().decide(self.late.pop(0))


def test_waits_have_one_timeout_so_that_no_topic_starves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With timeouts that alternate, an executor of rclpy serves its first topic alone."""
    monkeypatch.setattr("pipeprog_bringup.playback.player.IN_FLIGHT", 2)
    log, waits = Slow(), []

    def spin(seconds: float) -> None:
        waits.append(seconds)
        log.decide_one()

    bag = Bag.open(written(tmp_path, "times: stamps far apart"))
    Player(Doors(log), bag, log).play(None, spin, lambda due: None)
    assert len(waits) == 6
    assert len(set(waits)) == 1
