# SPDX-License-Identifier: Apache-2.0
"""A video without calibration: the focal length that it tells, marked as a guess all the way to the survey."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_bringup.footage.guessed_camera import guessed_camera
from pipeprog_bringup.footage.quicktime import read_movie
from pipeprog_bringup.footage.shot import Excerpt
from pipeprog_bringup.ingest import Request, ingest
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.replay import told_by
from pipeprog_camera.errors import InputError

NAMES = ("com.apple.quicktime.make", "com.apple.quicktime.camera.focal_length.35mm_equivalent")


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def metadata(kind: int, value: bytes) -> bytes:
    """Apple's metadata with two keys, a maker and the focal length."""
    keys = struct.pack(">II", 0, len(NAMES)) + b"".join(box(b"mdta", name.encode()) for name in NAMES)
    values = ((1, b"maker"), (kind, value))
    items = b"".join(
        box(struct.pack(">I", number), box(b"data", struct.pack(">II", type_, 0) + content))
        for number, (type_, content) in enumerate(values, start=1)
    )
    return box(b"meta", box(b"keys", keys) + box(b"ilst", items))


def film(path: Path, extra: bytes = b"") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (160, 96))
    for number in range(3):
        writer.write(np.full((96, 160, 3), 50 * number, np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes() + extra)
    return path


@pytest.mark.parametrize(("kind", "value"), [(21, b"\0\0\0\x1a"), (21, b"\x1a"), (1, b"26")])
def test_the_focal_length_is_that_of_35_mm_film(tmp_path: Path, kind: int, value: bytes) -> None:
    path = film(tmp_path / "walk.mp4", metadata(kind, value))
    assert read_movie(path).focal_length == 26.0
    camera = guessed_camera(path)
    assert camera.fx == camera.fy == pytest.approx(26 / 43.27 * np.hypot(160, 96))
    assert (camera.cx, camera.cy, camera.is_distorted) == (79.5, 47.5, False)


@pytest.mark.parametrize(
    "extra", [b"", metadata(21, b"\0"), metadata(1, b"wide"), metadata(1, b"\xff"), metadata(1, b"26")[:-30]]
)
def test_a_video_that_tells_nothing_is_refused_with_what_to_do(tmp_path: Path, extra: bytes) -> None:
    path = film(tmp_path / "walk.mp4", extra)
    with pytest.raises(InputError, match="calibrate in the video's own mode"):
        ingest(Request(path, None, tmp_path / "walk.mcap", Excerpt()), lambda share, text: None)
    assert not (tmp_path / "walk.mcap").exists()


def test_the_survey_learns_that_it_is_a_guess(tmp_path: Path) -> None:
    path = film(tmp_path / "walk.mp4", metadata(1, b"26"))
    made = ingest(Request(path, None, tmp_path / "walk.mcap", Excerpt()), lambda share, text: None)
    assert any("guess to 5%" in note for note in made.notes)
    bag = Bag.open(tmp_path / "walk.mcap")
    assert bag.focal_sigma == 0.05
    assert told_by(bag, set()) == ["sfm.calibration.focal_sigma=0.05", "sfm.calibration.distortion_sigma=0.1"]
    assert told_by(bag, {"sfm.calibration.focal_sigma"}) == ["sfm.calibration.distortion_sigma=0.1"]
