# SPDX-License-Identifier: Apache-2.0
"""A film of a board on disk becomes a calibration that `ingest --camera` reads."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_bringup.calibrate import MIN_GAP, Request, Runs, calibrate
from pipeprog_bringup.footage.camera_file import camera_file_text, read_camera_file
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError

FOCAL, WIDTH, HEIGHT = 520.0, 640, 360
PER_METRE = 1000.0  # px of the drawing
BOARD = """boards:
  - {name: A, circle_radius_mm: 40, centres_mm: [[-240, 150], [240, 150], [80, 30], [-240, -150], [240, -150]]}
"""


def drawing() -> np.ndarray:
    """(H, W) of the board on a grey wall, 2 m by 1.6 m, its middle in the middle."""
    image = np.full((1600, 2000), 140, np.uint8)
    cv2.rectangle(image, (700, 590), (1300, 1010), 20, -1)
    for x, y in ((-240, 150), (240, 150), (80, 30), (-240, -150), (240, -150)):
        cv2.circle(image, (16 * (1000 + x), 16 * (800 - y)), 16 * 40, 230, -1, cv2.LINE_AA, 4)
    return image


def write_film(path: Path, frames: int) -> None:
    k = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    board_from_drawing = np.array([[1 / PER_METRE, 0, -1.0], [0, -1 / PER_METRE, 0.8], [0, 0, 1]])
    plane = drawing()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (WIDTH, HEIGHT))
    for time in np.arange(frames) / 30:
        yaw, pitch = 0.6 * np.sin(5 * time), 0.5 * np.cos(4 * time)
        turn = Rotation.from_euler("yx", [yaw, pitch]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        shift = [0.12 * np.sin(3 * time), 0.06 * np.cos(6 * time), 0.9 + 0.1 * np.sin(2 * time)]
        homography = k @ np.c_[turn[:, :2], shift] @ board_from_drawing
        image = cv2.warpPerspective(plane, homography, (WIDTH, HEIGHT), flags=cv2.INTER_AREA, borderValue=140)
        writer.write(cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 0.6), cv2.COLOR_GRAY2BGR))
    writer.release()


def test_a_film_becomes_a_calibration_that_ingest_reads(tmp_path: Path) -> None:
    write_film(tmp_path / "board.avi", 24)
    (tmp_path / "board.yaml").write_text(BOARD)
    request = Request(tmp_path / "board.avi", tmp_path / "board.yaml", tmp_path / "camera.yaml")
    found = calibrate(request, lambda share, stage: None)
    read = read_camera_file(tmp_path / "camera.yaml")
    assert read.camera == found.camera
    assert read.readout == found.readout == 0.0
    assert found.camera.fx == pytest.approx(FOCAL, rel=0.005)
    assert (found.camera.width, found.camera.height) == (WIDTH, HEIGHT)
    assert found.rms < 0.1


def test_files_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    write_film(tmp_path / "board.avi", 6)
    (tmp_path / "board.yaml").write_text(BOARD)
    (tmp_path / "marks.yaml").write_text("marks: [{circle_radius_mm: 40, distance_mm: 900, sigma_mm: 1}]")
    (tmp_path / "no.avi").write_text("no video")
    for film, board, words in (
        ("board.avi", "marks.yaml", r"marks\.yaml has no board"),
        ("no.avi", "board.yaml", r"no\.avi is no video"),
        ("absent.mcap", "board.yaml", r"absent\.mcap"),
        ("board.avi", "board.yaml", r"board\.avi: the board was seen in \d images, 15 are needed"),
    ):
        with pytest.raises(InputError, match=words):
            calibrate(Request(tmp_path / film, tmp_path / board, tmp_path / "c.yaml"), lambda share, stage: None)
    assert not (tmp_path / "c.yaml").exists()


def test_runs_of_five_are_spread_over_a_film() -> None:
    runs = Runs(30.0, 10)
    times = [time for time in np.arange(900) / 30 if runs.wants(time)]
    assert len(times) == 50
    assert times[4] == pytest.approx(4 / 30)
    assert times[5] == pytest.approx(3.0)
    short = Runs(1.0, 50)
    assert sum(short.wants(time) for time in np.arange(30) / 30) == 30
    fast = Runs(1.0, 50)
    taken = [time for time in np.arange(240) / 240 if fast.wants(time)]
    assert np.diff(taken).min() > 0.99 * MIN_GAP


@pytest.mark.parametrize("readout", [None, 0.0, 0.0151])
@pytest.mark.parametrize(("model", "count"), [("plumb_bob", 5), ("equidistant", 4)])
def test_a_calibration_is_read_as_it_was_written(tmp_path: Path, readout: float | None, model: str, count: int) -> None:
    camera = Camera(1280, 720, 913.9, 914.1, 640.2, 358.7, model, tuple(0.01 / (k + 1) for k in range(count)))
    (tmp_path / "c.yaml").write_text(camera_file_text(camera, readout, ["a comment"]))
    read = read_camera_file(tmp_path / "c.yaml")
    assert (read.camera, read.readout) == (camera, readout)
