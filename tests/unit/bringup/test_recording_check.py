# SPDX-License-Identifier: Apache-2.0
"""What is told of a recording before a survey."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_bringup import cli, recording_check
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording_check import Findings
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_file import BoardFile, ScaleBar, load_board_file
from pipeprog_sfm.config import BoardConfig
from tests.unit.bringup.recordings import camera_messages, image, info, write_bag

BOARD = (
    "boards: [{name: A, circle_radius_mm: 20, centres_mm: [[-100, 60], [100, 60], [0, 0], [-100, -60], [100, -60]]}]"
)
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


@pytest.fixture
def board_file(tmp_path: Path) -> BoardFile:
    (tmp_path / "board.yaml").write_text(BOARD)
    return load_board_file(tmp_path / "board.yaml")


def bag_of(folder: Path, pixels: np.ndarray, count: int = 4, odometry: bool = False) -> Bag:
    """One content, past which a camera of 320 x 240 moves by 4 px an image."""
    return bag_with(folder, [np.roll(pixels, 4 * number, axis=1) for number in range(count)], odometry)


def bag_with(folder: Path, images: list[np.ndarray], odometry: bool = False) -> Bag:
    messages = []
    for number, pixels in enumerate(images):
        encoded = cv2.imencode(".png", pixels)[1].tobytes()
        messages += [
            ("/camera/camera_info", "sensor_msgs/msg/CameraInfo", number, info(number, CAMERA)),
            ("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", number, image(number, encoded=encoded)),
            *([("/odom", cdr.ODOMETRY, number, b"odometry")] if odometry else []),
        ]
    return Bag.open(write_bag(folder / "made.mcap", messages))


def picture_of_a_wall() -> np.ndarray:
    """Patches of 10 px and of 20 to 120 grey levels."""
    patches = np.random.default_rng(1).integers(20, 120, (24, 32), dtype=np.uint8)
    return np.kron(patches, np.ones((10, 10), np.uint8))


def picture_of_the_board() -> np.ndarray:
    """The board on the wall from 0.5 m, straight ahead: 0.6 px a millimetre."""
    pixels = picture_of_a_wall()
    pixels[65:175, 75:245] = 20
    for x, y in ((-100, 60), (100, 60), (0, 0), (-100, -60), (100, -60)):
        centre = (round(16 * (159.5 + 0.6 * x)), round(16 * (119.5 - 0.6 * y)))
        cv2.circle(pixels, centre, (16 * 12), 230, -1, cv2.LINE_AA, shift=4)
    return pixels


def looked_at(bag: Bag, board_file: BoardFile, has_reference: bool = False) -> Findings:
    return recording_check.first_look(bag, board_file, BoardConfig(), has_reference)


def test_a_good_recording_is_described(tmp_path: Path, board_file: BoardFile) -> None:
    found = recording_check.check(bag_of(tmp_path, picture_of_the_board()), board_file, 10_000_000)
    assert found.faults == found.notes == []
    expected = {"frames": 4, "seconds": 0.6, "frames_per_second": 5.0, "black": 0, "boards_seen": {"A": 4}}
    assert found.facts.items() >= {**expected, "frames_searched": 4, "memory_mb": 1800}.items()
    assert looked_at(bag_of(tmp_path, picture_of_the_board()), board_file) == Findings()


@pytest.mark.parametrize(
    ("size", "frames", "seconds", "written"),
    [(9.6, 65, 12.8, 113.7), (15.4, 65, 12.8, 124.5), (20.9, 80, 15.8, 116.0), (28.8, 120, 39.7, 356.9)],
    ids=["the demo", "the demo as a video", "a lab", "a field"],
)
def test_the_results_to_be_expected_are_near_those_that_were_written(
    size: float, frames: int, seconds: float, written: float
) -> None:
    assert recording_check._result_mb(round(size * 1e6), frames, seconds) == pytest.approx(written, rel=0.3)


def test_a_board_that_no_frame_shows_gives_no_result(tmp_path: Path, board_file: BoardFile) -> None:
    bag = bag_of(tmp_path, picture_of_a_wall(), 30)
    for found in (looked_at(bag, board_file), recording_check.check(bag, board_file, 1)):
        (told,) = found.faults
        assert f"no board (A) of {tmp_path / 'board.yaml'} was seen in 30 frames of 30, and nothing else tells" in told
        assert "is it the file of the board that hangs" in told


def test_a_board_in_one_frame_that_is_no_sample_is_found(tmp_path: Path, board_file: BoardFile) -> None:
    images = [np.roll(picture_of_a_wall(), 4 * number, axis=1) for number in range(30)]
    images[27] = picture_of_the_board()
    bag = bag_with(tmp_path, images)
    assert looked_at(bag, board_file) == Findings()
    found = recording_check.check(bag, board_file, 1)
    assert (found.faults, found.notes) == ([], [])
    assert found.facts["boards_seen"] == {"A": 1}


def test_where_the_scale_may_come_from_elsewhere_a_board_that_is_not_seen_is_noted(
    tmp_path: Path, board_file: BoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = bag_of(tmp_path, picture_of_a_wall())
    with_marks = replace(board_file, scale_bars=(ScaleBar("marks 1", 0.05, 2.0, 0.001),))
    (tmp_path / "robot").mkdir()
    robot = bag_of(tmp_path / "robot", picture_of_a_wall(), odometry=True)
    for found in (looked_at(wall, board_file, True), looked_at(wall, with_marks), looked_at(robot, board_file)):
        assert found.faults == []
        assert [note.partition(" was seen in ")[2][:14] for note in found.notes] == ["4 frames of 4:"]
    assert looked_at(wall, BoardFile(), has_reference=True) == Findings()
    monkeypatch.setattr(Bag, "focal_sigma", 0.1)  # its boards may be found with a better focal length
    assert looked_at(wall, board_file).faults == []


def test_a_rig_is_refused_where_each_of_its_cameras_has_a_fault(tmp_path: Path, board_file: BoardFile) -> None:
    (tmp_path / "other").mkdir()
    wall, board = (
        bag_of(tmp_path, picture_of_a_wall(), 3),
        bag_of(tmp_path / "other", picture_of_the_board()),
    )
    assert looked_at(replace(wall, rig=(wall, board)), board_file) == Findings()
    assert looked_at(replace(wall, rig=(wall, wall)), board_file).faults == looked_at(wall, board_file).faults


def test_black_frames_few_frames_and_no_scale_are_refused_at_once(tmp_path: Path, board_file: BoardFile) -> None:
    (black,) = looked_at(bag_of(tmp_path, np.full((240, 320), 3, np.uint8)), board_file).faults
    assert "all 4 frames looked at are black" in black
    few, scale = looked_at(bag_of(tmp_path, picture_of_the_board(), 3), BoardFile()).faults
    assert "has 3 images on /camera/image/compressed: a survey needs 4" in few
    assert "nothing tells the scale" in scale


@pytest.mark.parametrize(
    ("pixels", "remedy"),
    [
        (np.full((240, 320), 120, np.uint8), "add light"),
        (np.full((240, 320), 255, np.uint8), "expose for less"),
        (
            np.repeat(np.array([[60, 180]], np.uint8), 160, axis=1).repeat(240, axis=0),
            "film surfaces that are not bare",
        ),
    ],
    ids=["grey", "white", "two bare walls"],
)
def test_frames_without_a_corner_are_refused_with_the_remedy(
    tmp_path: Path, board_file: BoardFile, pixels: np.ndarray, remedy: str
) -> None:
    bag = bag_of(tmp_path, pixels, odometry=True)
    for found in (looked_at(bag, board_file), recording_check.check(bag, board_file, 1)):
        (told,) = found.faults
        assert "no frame of 4 looked at shows 30 corners" in told
        assert remedy in told
        assert found.notes == []


def test_a_camera_that_stands_is_refused_and_a_rig_is_not(tmp_path: Path, board_file: BoardFile) -> None:
    noise = np.random.default_rng(1).integers(-5, 6, (4, 240, 320))
    bag = bag_with(tmp_path, [np.clip(picture_of_the_board() + each, 0, 255).astype(np.uint8) for each in noise])
    for found in (looked_at(bag, board_file), recording_check.check(bag, board_file, 1)):
        (told,) = found.faults
        assert "all 4 frames looked at show the same image" in told
    assert looked_at(replace(bag, rig=(bag, bag)), board_file) == Findings()


def test_the_start_of_a_replay_takes_some_seconds_only(
    tmp_path: Path, board_file: BoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_check, "_SECONDS", -1.0)
    monkeypatch.setattr(recording_check, "_SEARCH_SECONDS", -1.0)
    assert looked_at(bag_of(tmp_path, np.full((240, 320), 3, np.uint8)), board_file) == Findings()


def test_what_was_not_looked_at_may_show_the_board(
    tmp_path: Path, board_file: BoardFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [np.roll(picture_of_a_wall(), 4 * number, axis=1) for number in range(30)]
    images[27] = picture_of_the_board()
    bag = bag_with(tmp_path, images)

    def searched(limit: float) -> tuple[int, bool]:
        found = recording_check._search_boards(bag, images[:1], board_file.boards, BoardConfig(), limit)
        assert found.seen == {"A": 0}
        return found.frames, found.is_complete

    assert searched(-1.0) == (0, False)
    monkeypatch.setattr(recording_check, "gray_image", lambda *_: None)  # more than 8 bits a channel
    assert searched(60.0) == (0, False)


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
