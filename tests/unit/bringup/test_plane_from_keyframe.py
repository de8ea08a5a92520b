# SPDX-License-Identifier: Apache-2.0
"""A line on a keyframe of a finished survey as the plane that cuts the pipes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_bringup.plane_from_keyframe import as_points
from pipeprog_bringup.results.result_files import write_trajectory
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_detect.cloud.cutting_planes import parse_planes
from tests.unit.bringup.recordings import START, STEP, image, info, write_bag

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, "plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.0))
TURN = Rotation.from_euler("xyz", [-100.0, 20.0, 5.0], degrees=True)
CENTRES = np.array([[0.0, -2.0, 1.0], [0.4, -2.1, 1.2]])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    messages = []
    for number in range(2):
        stamp = START + number * STEP
        messages += [("/camera/camera_info", "sensor_msgs/msg/CameraInfo", stamp, info(number, CAMERA))]
        messages += [("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", stamp, image(number))]
    write_bag(tmp_path / "out.mcap", messages)
    write_trajectory(tmp_path / "trajectory.tum", [START, START + STEP], CENTRES, np.tile(TURN.as_quat(), (2, 1)))
    return tmp_path


def test_the_plane_holds_the_camera_and_what_the_line_covers(run: Path) -> None:
    # Two points before the second keyframe, in its image.
    in_camera = np.array([[-0.5, 0.3, 1.7], [0.7, -0.4, 2.4]])
    pinhole = in_camera[:, :2] / in_camera[:, 2:] * 60.0 + [31.5, 23.5]
    (u1, v1), (u2, v2) = CAMERA.distort_points(pinhole)
    in_map = CENTRES[1] + TURN.apply(in_camera)
    other = "0,0,0 1,0,0 0,1,0"
    drawn, given = parse_planes(as_points(f"2:{u1},{v1},{u2},{v2};{other}", run))
    for point in (CENTRES[1], *in_map):
        assert abs((point - drawn.point) @ drawn.normal) < 1e-5
    np.testing.assert_allclose(np.abs(given.normal), [0, 0, 1])


def test_three_points_stay_as_they_are(tmp_path: Path) -> None:
    assert as_points("0,0,0 1,0,0 0,1,0", tmp_path) == "0,0,0 1,0,0 0,1,0"


@pytest.mark.parametrize(
    ("plane", "why"),
    [
        ("1:5,5,64,20", "leaves the image of 64 x 48"),
        ("1:5,-1,30,20", "leaves the image"),
        ("1:5,nan,30,20", "leaves the image"),
        ("3:5,5,30,20", "keyframes 1 to 2"),
        ("0:5,5,30,20", "keyframes 1 to 2"),
        ("1:5,5,9,9", "shorter than 10 px"),
        ("1:5,5,30", "KEYFRAME:u1,v1,u2,v2"),
        ("1:5,5:30,20", "KEYFRAME:u1,v1,u2,v2"),
    ],
)
def test_what_is_no_line_on_a_keyframe_is_reported(run: Path, plane: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        as_points(plane, run)


def test_a_line_without_a_survey_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no trajectory\.tum"):
        as_points("1:5,5,30,20", tmp_path)
