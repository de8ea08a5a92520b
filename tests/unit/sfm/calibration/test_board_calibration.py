# SPDX-License-Identifier: Apache-2.0
"""The camera from circles of a board: found within the limits that a survey needs, or refused with what to film."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.calibration.board_calibration import adjusted_camera, calibrate
from pipeprog_sfm.calibration.board_images import BoardImage, runs_of, turned_alike

X, Y = 0.24, 0.15
BOARD = Board("A", 0.04, np.array([[-X, Y, 0], [X, Y, 0], [0, 0, 0], [-X, -Y, 0], [X, -Y, 0]]))
PINHOLE = Camera(1280, 720, 910.0, 912.0, 645.0, 352.0, "plumb_bob", (-0.08, 0.03, 0.0005, -0.0004, 0.0))
FISHEYE = Camera(1280, 720, 700.0, 700.0, 640.0, 362.0, "equidistant", (0.02, -0.01, 0.003, 0.0))
NOISE = 0.05  # px


def pose(time: float, tilt: float = 0.6) -> FloatArray:
    """camera_from_board (4, 4) of a hand that waves a camera about a metre before the board."""
    yaw, pitch, roll = tilt * np.sin(1.9 * time), tilt * np.cos(1.3 * time + 0.4), 0.3 * np.sin(0.7 * time)
    camera = np.eye(4)
    camera[:3, :3] = Rotation.from_euler("yxz", [yaw, pitch, roll]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    camera[:3, 3] = [0.35 * np.sin(2.3 * time), 0.2 * np.cos(2.9 * time), 0.95 + 0.25 * np.sin(1.1 * time)]
    return camera


def pixel_of(point: FloatArray, camera: Camera, readout: float, time: float, tilt: float) -> FloatArray:
    """Where a camera shows a point whose row is read while the hand moves on."""
    pixel = np.array([camera.cx, camera.cy])
    for _ in range(4 if readout else 1):
        moment = pose(time + ((pixel[1] + 0.5) / camera.height - 0.5) * readout, tilt)
        x, y, z = moment[:3, :3] @ point + moment[:3, 3]
        pixel = camera.distort_points([[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]])[0]
    return pixel


def film(camera: Camera, readout: float = 0.0, runs: int = 30, tilt: float = 0.6) -> list[BoardImage]:
    """Runs of five images at 30 Hz, spread over half a minute."""
    rng = np.random.default_rng(3)
    images = []
    for start in np.linspace(0, 29, runs):
        for number in range(5):
            time = start + number / 30
            own = pose(time, tilt)
            pixels = np.array([pixel_of(circle, camera, readout, time, tilt) for circle in BOARD.centres])
            pixels = pixels + NOISE * rng.standard_normal(pixels.shape)
            seen = (pixels > 20).all(1) & (pixels < [camera.width - 20, camera.height - 20]).all(1)
            if seen.sum() >= 4:
                near = own.copy()
                near[:3, 3] *= 1.03
                images.append(BoardImage(round(time * 1e9), np.flatnonzero(seen), pixels[seen], near))
    return images


def guess(camera: Camera) -> Camera:
    return Camera(camera.width, camera.height, 1024.0, 1024.0, 639.5, 359.5, camera.distortion_model)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_camera_and_readout_are_found(camera: Camera) -> None:
    images = film(camera, readout=0.015)
    found = calibrate(images, BOARD, adjusted_camera(images, BOARD, guess(camera)))
    assert found.readout == pytest.approx(0.015, rel=0.03)
    assert found.camera.fx == pytest.approx(camera.fx, rel=5e-4)
    assert found.camera.fy == pytest.approx(camera.fy, rel=5e-4)
    assert found.rms < 0.1
    assert abs(found.camera.fx - camera.fx) < 5 * found.sigmas["fx"]
    assert found.sigmas["fx"] < 5e-4 * camera.fx
    assert abs(found.camera.cx - camera.cx) < 1.0


def test_a_global_shutter_has_a_readout_of_zero() -> None:
    found = calibrate(film(PINHOLE), BOARD, PINHOLE)
    assert found.readout == 0.0
    assert found.sigmas["readout"] < 1e-3
    assert found.sigmas["k3"] == 0.0, "the images do not tell it"
    assert not any("read-out" in sentence for sentence in found.advice())


def test_images_that_are_far_apart_tell_no_readout() -> None:
    found = calibrate(film(PINHOLE, readout=0.015)[::5], BOARD, PINHOLE)
    assert found.readout is None
    assert "readout" not in found.values
    assert any("read-out" in sentence for sentence in found.advice())


def test_k3_is_found_where_there_is_one() -> None:
    lens = replace(PINHOLE, distortion=(-0.08, 0.03, 0.0, 0.0, -0.1))
    found = calibrate(film(lens), BOARD, lens)
    assert found.camera.distortion[4] == pytest.approx(-0.1, abs=0.03)


def test_empty_corners_are_told() -> None:
    images = [
        replace(image, pixels=image.pixels[near], circles=image.circles[near])
        for image in film(PINHOLE)
        if (near := (abs(image.pixels - [640, 360]) < [380, 220]).all(1)).sum() >= 4
    ]
    assert "corners" in calibrate(images, BOARD, PINHOLE).advice()[0]


def test_runs_are_of_images_that_follow_one_another() -> None:
    gap = 33_000_000
    assert runs_of([0, gap, 2 * gap, 10 * gap, 11 * gap]).tolist() == [0, 0, 0, 1, 1]
    assert runs_of([gap * number for number in range(7)]).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert not len(runs_of([]))


def test_a_board_that_looks_alike_upside_down_stays_as_it_was() -> None:
    first, second, *_ = film(PINHOLE)
    flipped = replace(
        second,
        circles=np.array([4, 3, 2, 1, 0])[second.circles],
        camera_from_board=second.camera_from_board @ BOARD.half_turn,
    )
    alike = turned_alike([first, flipped], BOARD)[1]
    assert np.array_equal(alike.circles, second.circles)
    assert np.allclose(alike.camera_from_board, second.camera_from_board)


def test_films_that_cannot_tell_are_refused() -> None:
    images = film(PINHOLE, runs=6)
    with pytest.raises(InputError, match="not seen in any image"):
        calibrate([], BOARD, guess(PINHOLE))
    with pytest.raises(InputError, match="15 are needed"):
        calibrate(images[:9], BOARD, guess(PINHOLE))
    with pytest.raises(InputError, match="one side only"):
        calibrate(film(PINHOLE, tilt=0.0, runs=6), BOARD, guess(PINHOLE))
