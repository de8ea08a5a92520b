# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from pipeprog_bringup.ingest import START, Ingested, ingest, read_camera
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError

FRAMES = 12


def video(path: Path, width: int = 160, height: int = 96, rate: float = 25.0) -> Path:
    """Frames with a bright left edge that grow lighter."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
    for number in range(FRAMES):
        image = np.full((height, width, 3), 10 * number, np.uint8)
        image[:, : width // 4] = 255
        writer.write(image)
    writer.release()
    return path


def turn(path: Path) -> None:
    """Write a rotation of 90 degrees into the track header, as a phone held upright does (ISO 14496-12, 8.3.2)."""
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)


def calibration(path: Path, width: int = 160, height: int = 96, **changes: object) -> Path:
    content = {
        "image_width": width,
        "image_height": height,
        "camera_name": "phone",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [150.0, 0, 79.5, 0, 150.0, 47.5, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, -0.05, 0, 0, 0]},
        **changes,
    }
    path.write_text(yaml.safe_dump(content))
    return path


def frame_size(data: bytes) -> tuple[int, int]:
    return encoded_size(bytes(cdr.read_image(data, cdr.COMPRESSED_IMAGE).data))


def run(folder: Path, source: Path, camera: Path, force: bool = False) -> Ingested:
    return ingest(source, camera, folder / "bag.mcap", 95, force, lambda share, text: None)


def test_a_video_becomes_a_recording(tmp_path: Path) -> None:
    ingested = run(tmp_path, video(tmp_path / "v.mp4"), calibration(tmp_path / "c.yaml"))
    bag = Bag.open(tmp_path / "bag.mcap")
    frames = list(bag)
    assert len(frames) == ingested.frames == FRAMES
    assert bag.camera.distortion == (0.1, -0.05, 0, 0, 0)
    np.testing.assert_allclose([frame.stamp for frame in frames], START + 40_000_000 * np.arange(FRAMES), atol=1e5)
    assert ingested.notes == []
    assert frame_size(frames[0].data) == (160, 96)


def test_a_calibration_of_another_size_is_scaled_where_the_aspect_fits(tmp_path: Path) -> None:
    ingested = run(tmp_path, video(tmp_path / "v.mp4"), calibration(tmp_path / "c.yaml", 320, 192))
    camera = Bag.open(tmp_path / "bag.mcap").camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (160, 96, 75.0, 39.5)
    assert "scaled" in ingested.notes[0]
    with pytest.raises(InputError, match="another aspect"):
        run(tmp_path, tmp_path / "v.mp4", calibration(tmp_path / "c.yaml", 320, 240), force=True)


def test_a_turned_video_is_taken_as_the_calibration_has_it(tmp_path: Path) -> None:
    turn(video(tmp_path / "v.mp4"))
    run(tmp_path, tmp_path / "v.mp4", calibration(tmp_path / "sensor.yaml"))
    bag = Bag.open(tmp_path / "bag.mcap")
    assert frame_size(next(iter(bag)).data) == (160, 96)
    run(tmp_path, tmp_path / "v.mp4", calibration(tmp_path / "upright.yaml", 96, 160), force=True)
    bag = Bag.open(tmp_path / "bag.mcap")
    assert frame_size(next(iter(bag)).data) == (96, 160)


def test_a_recording_is_not_replaced_without_force(tmp_path: Path) -> None:
    source, camera = video(tmp_path / "v.mp4"), calibration(tmp_path / "c.yaml")
    run(tmp_path, source, camera)
    with pytest.raises(InputError, match="exists"):
        run(tmp_path, source, camera)
    run(tmp_path, source, camera, force=True)


def test_bad_videos_are_errors_and_leave_nothing(tmp_path: Path) -> None:
    camera = calibration(tmp_path / "c.yaml")
    (tmp_path / "text.mp4").write_text("no video")
    cut = video(tmp_path / "cut.mp4")
    cut.write_bytes(cut.read_bytes()[:600])
    for name, expected in (("absent.mp4", "no such video"), ("text.mp4", "is no video"), ("cut.mp4", "cut.mp4")):
        with pytest.raises(InputError, match=expected):
            run(tmp_path, tmp_path / name, camera)
    with pytest.raises(InputError, match=r"\.mcap"):
        ingest(video(tmp_path / "v.mp4"), camera, tmp_path / "bag.bag", 95, False, lambda share, text: None)
    assert not (tmp_path / "bag.mcap").exists()
    assert not list(tmp_path.glob(".pipeprog*"))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_matrix": {"data": [1, 2]}}, "no camera calibration"),
        ({"camera_matrix": {"data": [0.0] * 9}}, "not calibrated"),
        ({"distortion_model": "wavy"}, "unknown distortion model 'wavy'"),
        ({"image_width": "wide"}, "no camera calibration"),
        ({"distortion_coefficients": None}, "no camera calibration"),
        ({"image_width": math.inf}, r"image_width, line \d+ holds inf, which is no number"),
        ({"image_width": [640]}, r"image_width, line \d+ holds \[640\], which is no number"),
        ({"camera_matrix": {"data": "123456789"}}, "camera_matrix.data is missing"),
        ({"camera_matrix": {"data": [{}] * 9}}, r"camera_matrix.data, line \d+ holds {}, which is no number"),
        ({"distortion_model": ["plumb_bob"]}, r"distortion_model is \['plumb_bob'\]: write a name"),
    ],
)
def test_bad_calibrations_are_errors(tmp_path: Path, changes: dict[str, Any], expected: str) -> None:
    path = calibration(tmp_path / "c.yaml", **changes)
    with pytest.raises(InputError, match=expected) as caught:
        read_camera(path)
    assert str(path) in str(caught.value)


def test_a_calibration_that_is_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("{")
    for name, expected in (("c.yaml", r"c\.yaml, line 2: is no YAML"), ("absent.yaml", r"absent\.yaml: cannot read")):
        with pytest.raises(InputError, match=expected):
            read_camera(tmp_path / name)
