# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.footage.quicktime import Movie, read_movie
from pipeprog_bringup.footage.shot import UNDATED, Excerpt
from pipeprog_bringup.ingest import Ingested, Request, ingest
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


def run(
    folder: Path, source: Path, camera: Path, force: bool = False, excerpt: Excerpt | None = None, out: str = "bag.mcap"
) -> Ingested:
    request = Request(source, camera, folder / out, excerpt or Excerpt(), 95, force)
    return ingest(request, lambda share, text: None)


def test_a_video_becomes_a_recording(tmp_path: Path) -> None:
    ingested = run(tmp_path, video(tmp_path / "v.mp4"), calibration(tmp_path / "c.yaml"))
    bag = Bag.open(tmp_path / "bag.mcap")
    frames = list(bag)
    assert len(frames) == ingested.frames == FRAMES
    assert bag.camera.distortion == (0.1, -0.05, 0, 0, 0)
    np.testing.assert_allclose([frame.stamp for frame in frames], UNDATED + 40_000_000 * np.arange(FRAMES), atol=1e5)
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
        run(tmp_path, video(tmp_path / "v.mp4"), camera, out="bag.bag")
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
        read_camera_file(path)
    assert str(path) in str(caught.value)


def test_a_calibration_that_is_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("{")
    for name, expected in (
        ("c.yaml", r"c\.yaml, line 2: is no YAML"),
        ("absent.yaml", r"no such file: .*absent\.yaml"),
    ):
        with pytest.raises(InputError, match=expected):
            read_camera_file(tmp_path / name)


def lying_avi(path: Path, size: tuple[int, int] = (160, 96), rate: tuple[int, int] = (1, 25), frames: int = 12) -> Path:
    """An AVI of twelve JPEG frames of 160 x 96 whose headers say something else (scale and rate, number of frames)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 96))
    for number in range(FRAMES):
        writer.write(np.full((96, 160, 3), 10 * number, np.uint8))
    writer.release()
    content = path.read_bytes().replace(struct.pack("<II", 160, 96), struct.pack("<II", *size))
    content = content.replace(b"\x08" + struct.pack(">HH", 96, 160), b"\x08" + struct.pack(">HH", *size[::-1]))
    changed = bytearray(content)
    stream = content.index(b"strh") + 8
    struct.pack_into("<II", changed, stream + 20, *rate)
    struct.pack_into("<I", changed, stream + 32, frames)
    struct.pack_into("<I", changed, content.index(b"avih") + 8 + 16, frames)
    path.write_bytes(changed)
    return path


NO_VIDEOS = {
    "cut.mp4": b"\0\0\0\x18ftypisom\0\0\2\0isom\0\0\x40\0moov",
    "playlist.mp4": b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nv.mp4\n#EXT-X-ENDLIST\n",
    "list.mp4": b"ffconcat version 1.0\nfile v.mp4\n",
    "noise.mp4": np.random.default_rng(0).bytes(9000),
    "empty.mp4": b"",
}


@pytest.mark.parametrize("name", NO_VIDEOS)
def test_what_is_no_video_is_refused_and_opens_nothing_else(tmp_path: Path, name: str) -> None:
    video(tmp_path / "v.mp4")
    (tmp_path / name).write_bytes(NO_VIDEOS[name])
    with pytest.raises(InputError, match="is no video"):
        run(tmp_path, tmp_path / name, calibration(tmp_path / "c.yaml"))


def test_folders_and_pipes_are_refused_before_they_are_opened(tmp_path: Path) -> None:
    (tmp_path / "folder.mp4").mkdir()
    os.mkfifo(tmp_path / "pipe.mp4")
    for name in ("folder.mp4", "pipe.mp4"):
        with pytest.raises(InputError, match="a folder, a device or a pipe"):
            run(tmp_path, tmp_path / name, calibration(tmp_path / "c.yaml"))


@pytest.mark.parametrize("size", [(65_500, 65_500), (10_000, 10_000), (16, 16)])
def test_a_video_that_declares_a_size_it_has_not_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    source = lying_avi(tmp_path / "v.avi", size)
    with pytest.raises(InputError, match=r"too small|too large"):
        run(tmp_path, source, calibration(tmp_path / "c.yaml"))


@pytest.mark.parametrize("rate", [(0, 0), (0, 25), (1, 0), (1, (1 << 32) - 1), ((1 << 32) - 1, 1)])
def test_rates_that_are_none_give_stamps_that_rise(tmp_path: Path, rate: tuple[int, int]) -> None:
    ingested = run(tmp_path, lying_avi(tmp_path / "v.avi", rate=rate), calibration(tmp_path / "c.yaml"))
    stamps = [frame.stamp for frame in Bag.open(tmp_path / "bag.mcap")]
    assert stamps == sorted(set(stamps))
    assert ingested.frames == len(stamps) == FRAMES
    assert stamps[-1] < UNDATED + 86_400 * 10**9


def test_frames_that_are_declared_and_not_there_are_told(tmp_path: Path) -> None:
    ingested = run(tmp_path, lying_avi(tmp_path / "v.avi", frames=10**6), calibration(tmp_path / "c.yaml"))
    assert any("12 of 1000000 frames" in note for note in ingested.notes)


def dated(path: Path, seconds: int) -> Path:
    """The video with a time at which it was created, as phones write it: from 1904 on (ISO 14496-12, 8.2.2)."""
    content = bytearray(video(path).read_bytes())
    at = content.index(b"mvhd") + 8
    content[at : at + 4] = struct.pack(">I", seconds + 2_082_844_800)
    path.write_bytes(content)
    return path


def test_stamps_begin_when_the_video_was_filmed(tmp_path: Path) -> None:
    filmed = 1_772_445_600
    run(tmp_path, dated(tmp_path / "v.mp4", filmed), calibration(tmp_path / "c.yaml"))
    stamps = [frame.stamp for frame in Bag.open(tmp_path / "bag.mcap")]
    assert stamps[0] == filmed * 10**9
    assert abs(stamps[-1] - stamps[0] - (FRAMES - 1) * 40_000_000) < 1e5


def test_an_excerpt_at_fewer_images_a_second(tmp_path: Path) -> None:
    source, camera = video(tmp_path / "v.mp4"), calibration(tmp_path / "c.yaml")  # 12 frames, 0.04 s apart
    for excerpt, numbers in (
        (Excerpt(0.1, 0.3), (3, 4, 5, 6, 7)),
        (Excerpt(rate=12.5), (0, 2, 4, 6, 8, 10)),
        (Excerpt(rate=10), (0, 3, 5, 8, 10)),
        (Excerpt(0.2, rate=100), (5, 6, 7, 8, 9, 10, 11)),
    ):
        ingested = run(tmp_path, source, camera, True, excerpt)
        stamps = [frame.stamp for frame in Bag.open(tmp_path / "bag.mcap")]
        np.testing.assert_allclose(stamps, UNDATED + 40_000_000 * np.array(numbers), atol=1e5)
        assert ingested.notes == []
    with pytest.raises(InputError, match="no frame between --start and --end"):
        run(tmp_path, source, camera, True, Excerpt(5.0))


@pytest.mark.parametrize("excerpt", [(-1.0, 2.0), (3.0, 2.0), (math.nan, 2.0), (0.0, 1.0, 0.0), (0.0, 1.0, math.inf)])
def test_excerpts_that_are_none(excerpt: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"--start|--fps"):
        Excerpt(*excerpt)


def test_motion_jpeg_is_kept_as_it_is(tmp_path: Path) -> None:
    source = lying_avi(tmp_path / "v.avi")
    ingested = run(tmp_path, source, calibration(tmp_path / "c.yaml"))
    assert ingested.notes == ["12 frames were JPEG already and are kept as they were"]
    content = source.read_bytes()
    for frame in Bag.open(tmp_path / "bag.mcap"):
        assert bytes(cdr.read_image(frame.data, cdr.COMPRESSED_IMAGE).data) in content


def test_the_read_out_of_the_calibration_reaches_the_recording(tmp_path: Path) -> None:
    source = video(tmp_path / "v.mp4")
    run(tmp_path, source, calibration(tmp_path / "c.yaml", readout=0.015))
    assert Bag.open(tmp_path / "bag.mcap").readout == 0.015
    run(tmp_path, source, calibration(tmp_path / "c.yaml"), force=True)
    assert Bag.open(tmp_path / "bag.mcap").readout is None
    for readout in (-0.01, 1.0, math.nan, "fast"):
        with pytest.raises(InputError, match=r"c.yaml.*(read-out|readout)"):
            run(tmp_path, source, calibration(tmp_path / "c.yaml", readout=readout), force=True)


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def test_colours_that_jpeg_has_not_are_told(tmp_path: Path) -> None:
    colours = box(b"colr", b"nclx" + struct.pack(">HHH", 9, 18, 9) + b"\0")
    entry = box(b"hvc1", bytes(78) + colours + box(b"hvcC", bytes(17) + b"\xfa" + bytes(5)))
    inner = box(b"stsd", bytes(8) + entry)
    for kind in (b"stbl", b"minf", b"mdia", b"trak", b"moov"):
        inner = box(kind, inner)
    path = tmp_path / "v.mov"
    path.write_bytes(box(b"ftyp", b"qt  ") + inner)
    assert read_movie(path) == Movie(None, 10, "HLG")
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert read_movie(path).created is None


def test_boxes_without_end_end(tmp_path: Path) -> None:
    path = tmp_path / "v.mov"
    path.write_bytes(struct.pack(">I", 8) + b"free" + (struct.pack(">I", 8) + b"moov") * 50_000)
    assert read_movie(path) == Movie()
