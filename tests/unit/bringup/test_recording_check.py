# SPDX-License-Identifier: Apache-2.0
"""What is told of a recording before a survey."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_bringup import cli, recording_check
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file
from tests.unit.bringup.recordings import camera_messages, image, info, write_bag

BOARD = (
    "boards: [{name: A, circle_radius_mm: 20, centres_mm: [[-100, 60], [100, 60], [0, 0], [-100, -60], [100, -60]]}]"
)
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


@pytest.fixture
def board_file(tmp_path: Path) -> BoardFile:
    (tmp_path / "board.yaml").write_text(BOARD)
    return load_board_file(tmp_path / "board.yaml")


def bag_of(folder: Path, pixels: np.ndarray, count: int = 4) -> Bag:
    """Images of one content, before a camera of 320 x 240."""
    encoded = cv2.imencode(".png", pixels)[1].tobytes()
    messages = []
    for number in range(count):
        messages += [
            ("/camera/camera_info", "sensor_msgs/msg/CameraInfo", number, info(number, CAMERA)),
            ("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", number, image(number, encoded=encoded)),
        ]
    return Bag.open(write_bag(folder / "made.mcap", messages))


def picture_of_the_board() -> np.ndarray:
    """The board from 0.5 m, straight ahead: 0.6 px a millimetre."""
    pixels = np.full((240, 320), 40, np.uint8)
    for x, y in ((-100, 60), (100, 60), (0, 0), (-100, -60), (100, -60)):
        centre = (round(16 * (159.5 + 0.6 * x)), round(16 * (119.5 - 0.6 * y)))
        cv2.circle(pixels, centre, (16 * 12), 230, -1, cv2.LINE_AA, shift=4)
    return pixels


def test_a_good_recording_is_described(tmp_path: Path, board_file: BoardFile) -> None:
    found = recording_check.check(bag_of(tmp_path, picture_of_the_board()), board_file, 10_000_000)
    assert found.faults == []
    expected = {"frames": 4, "seconds": 0.6, "frames_per_second": 5.0, "black": 0, "boards_seen": {"A": 4}}
    assert found.facts.items() >= {**expected, "result_mb": 140, "memory_mb": 1800}.items()


def test_a_board_that_no_frame_shows_gives_no_result(tmp_path: Path, board_file: BoardFile) -> None:
    (told,) = recording_check.check(bag_of(tmp_path, np.full((240, 320), 90, np.uint8)), board_file, 1).faults
    assert "no board was seen in 4 frames of 4" in told


def test_black_frames_few_frames_and_no_scale_are_refused_at_once(tmp_path: Path, board_file: BoardFile) -> None:
    (black,) = recording_check.faults_of(bag_of(tmp_path, np.full((240, 320), 3, np.uint8)), board_file)
    assert "all 4 frames looked at are black" in black
    few, scale = recording_check.faults_of(bag_of(tmp_path, picture_of_the_board(), 3), BoardFile())
    assert "has 3 images on /camera/image/compressed: a survey needs 4" in few
    assert "nothing tells the scale" in scale
    assert recording_check.faults_of(bag_of(tmp_path, picture_of_the_board()), board_file) == []


def test_the_start_of_a_replay_reads_for_some_seconds_only(
    tmp_path: Path, board_file: BoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_check, "_SECONDS", -1.0)
    assert recording_check.faults_of(bag_of(tmp_path, np.full((240, 320), 3, np.uint8)), board_file) == []


def test_the_command_prints_json_and_ends_with_1_where_nothing_can_come_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "bag.mcap", camera_messages(8))
    (tmp_path / "board.yaml").write_text(BOARD)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    for options, code in (([], 1), (["--board", str(tmp_path / "board.yaml")], 1)):
        monkeypatch.setattr(sys, "argv", ["pipeprog", "check", str(bag), "--json", *options])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == code
        content = json.loads(capsys.readouterr().out)
        assert content["facts"]["frames"] == 8
        assert len(content["faults"]) == 1


def test_a_film_that_is_blurred_or_dark_as_a_whole_is_told_with_its_remedy(
    tmp_path: Path, board_file: BoardFile
) -> None:
    sharp = picture_of_the_board()
    for pixels, kind, remedy in (
        (cv2.GaussianBlur(sharp, (0, 0), 4.0), "blurred", "walk more slowly"),
        ((20 + sharp * 0.1).astype(np.uint8), "flat", "add light"),
        (np.clip(sharp * 7.0, 0, 255).astype(np.uint8), "overexposed", "expose for less"),
    ):
        found = recording_check.check(bag_of(tmp_path, pixels), board_file, 1)
        assert found.facts[kind] == 4
        (told,) = [note for note in found.notes if note.startswith("4 of 4 frames looked at are ")]
        assert remedy in told
    assert recording_check.check(bag_of(tmp_path, sharp), board_file, 1).notes == []
