# SPDX-License-Identifier: Apache-2.0
"""Folders and archives of scanning apps become the recording that the same pictures as mcap are."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_bringup.footage.shot import UNDATED, Excerpt
from pipeprog_bringup.ingest import Ingested, Request, ingest
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.recording.message_file import messages_of
from pipeprog_camera.errors import InputError
from tests.unit.bringup.footage.scans import COUNT, DEPTH, focal, polycam, record3d, stray, world_from_camera
from tests.unit.bringup.recordings import STEP, jpeg, pictures

SCANS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "polycam": ("scan", polycam),
    "stray": ("scan", stray),
    "record3d": ("scan.r3d", record3d),
}


def run(source: Path, excerpt: Excerpt | None = None) -> tuple[Ingested, Bag]:
    out = source.parent / "bag.mcap"
    request = Request(source, None, out, excerpt or Excerpt(), 95, True)
    return ingest(request, lambda share, text: None), Bag.open(out)


def made(folder: Path, app: str) -> Path:
    name, make = SCANS[app]
    return make(folder / name)


@pytest.mark.parametrize("app", SCANS)
def test_gives_the_pictures_with_their_stamps_and_the_intrinsics_of_each(tmp_path: Path, app: str) -> None:
    ingested, bag = run(made(tmp_path, app))
    frames = list(bag)
    assert ingested.frames == len(frames) == COUNT
    np.testing.assert_allclose([frame.stamp for frame in frames], UNDATED + STEP * np.arange(COUNT), atol=1000)
    for number, frame in enumerate(frames):
        assert not frame.fault
        assert cdr.read_camera_info(frame.camera_info).camera().fx == focal(number)
        encoded = bytes(cdr.read_image(frame.data, cdr.COMPRESSED_IMAGE).data)
        if app == "stray":
            picture = np.array(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR), int)
            assert np.abs(picture - pictures(COUNT)[number]).mean() < 8.0
        else:
            assert encoded == jpeg(number)


@pytest.mark.parametrize("app", ["polycam", "stray"])
def test_poses_are_odometry_in_the_axes_of_ros(tmp_path: Path, app: str) -> None:
    _, bag = run(made(tmp_path, app))
    told = [one for one in bag.with_motion() if isinstance(one, MotionMessage)]
    assert [one.topic for one in told] == COUNT * ["odometry"]
    for number, message in enumerate(told):
        # Position and quaternion, behind header (stamp, "odom") and "camera_optical_frame" to eight bytes.
        at = 4 + (8 + 4 + 5 + 3 + 4 + 21 + 7) // 8 * 8
        numbers = struct.unpack_from("<7d", message.data, at)
        expected = world_from_camera(number)
        np.testing.assert_allclose(numbers[:3], expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(numbers[3:]).as_matrix(), expected[:3, :3], atol=1e-6)


@pytest.mark.parametrize("app", ["polycam", "stray"])
def test_depth_and_confidence_are_kept_with_their_camera(tmp_path: Path, app: str) -> None:
    _, bag = run(made(tmp_path, app))
    assert bag.image_topic == "/camera/image/compressed"
    for topic in ("/camera/depth/image", "/camera/depth/confidence"):
        images = [cdr.read_image(message.data, cdr.IMAGE) for message in messages_of(bag._files, {topic})]
        assert [(image.encoding, image.width, image.height) for image in images] == COUNT * [("16UC1", 128, 96)]
        values = [np.frombuffer(image.data, np.uint16).reshape(96, 128) for image in images]
        if topic.endswith("image"):
            assert all((value == DEPTH).all() for value in values)
        else:
            assert [value[0, 0] for value in values] == [0, 1, 2, 0]
    infos = [cdr.read_camera_info(one.data) for one in messages_of(bag._files, {"/camera/depth/camera_info"})]
    assert [info.camera().fx for info in infos] == [focal(number) * 2 for number in range(COUNT)]


@pytest.mark.parametrize("app", SCANS)
def test_an_excerpt(tmp_path: Path, app: str) -> None:
    ingested, bag = run(made(tmp_path, app), Excerpt(0.15, 0.45))
    assert ingested.frames == 2
    assert [round((frame.stamp - UNDATED) / STEP) for frame in bag] == [1, 2]


def test_torn_copies_give_what_they_still_hold(tmp_path: Path) -> None:
    folder = polycam(tmp_path / "scan")
    picture = sorted((folder / "keyframes" / "corrected_images").iterdir())[1]
    picture.write_bytes(picture.read_bytes()[:9])
    sorted((folder / "keyframes" / "corrected_cameras").iterdir())[3].unlink()
    ingested, bag = run(folder)
    assert len(list(bag)) == 2
    assert "2 pictures left out" in ingested.notes[0]
    scan = stray(tmp_path / "stray")
    rows = (scan / "odometry.csv").read_text()
    (scan / "odometry.csv").write_text(rows[:-60])
    ingested, bag = run(scan)
    assert len(list(bag)) == 3
    assert "odometry.csv has 3 rows for 4 pictures" in ingested.notes[0]
    archive = record3d(tmp_path / "half.r3d")
    archive.write_bytes(archive.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"half\.r3d is cut off or no archive of Record3D"):
        run(archive)


def test_what_is_no_scan(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "v.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"no scan of Stray Scanner or Polycam"):
        run(tmp_path / "folder")
    with pytest.raises(InputError, match=r"v\.mp4 is no video that can be read"):
        run(tmp_path / "v.mp4")
    (tmp_path / "p.JPG").write_bytes(b"")
    with pytest.raises(InputError, match=r"p\.JPG is a picture: give a video, or the folder of the pictures"):
        run(tmp_path / "p.JPG")


HOSTILE_ROWS = {
    "no columns": "a,b\n1,2\n",
    "no rows": "timestamp, frame, x, y, z, qx, qy, qz, qw\n",
    "no quaternion": "timestamp, frame, x, y, z, qx, qy, qz, qw\n1, 0, 0, 0, 0, 0, 0, 0, 9\n",
    "a time that falls": "timestamp, frame, x, y, z, qx, qy, qz, qw\n" + 2 * "1, 0, 0, 0, 0, 0, 0, 0, 1\n",
    "a time beyond all": "timestamp, frame, x, y, z, qx, qy, qz, qw\n1e300, 0, 0, 0, 0, 0, 0, 0, 1\n",
    "a frame beyond all": "timestamp, frame, x, y, z, qx, qy, qz, qw\n1, 1e18, 0, 0, 0, 0, 0, 0, 1\n",
    "a place beyond all": "timestamp, frame, x, y, z, qx, qy, qz, qw\n1, 0, 1e300, 0, 0, 0, 0, 0, 1\n",
    "noise": "\0\x01;;,\n",
}


@pytest.mark.parametrize("what", HOSTILE_ROWS)
def test_hostile_rows_of_stray_scanner_are_refused(tmp_path: Path, what: str) -> None:
    folder = stray(tmp_path / "scan")
    (folder / "odometry.csv").write_text(HOSTILE_ROWS[what])
    with pytest.raises(InputError, match=r"odometry\.csv"):
        run(folder)


def metadata(path: Path, **changes: object) -> Path:
    """The recording with other metadata."""
    record3d(path)
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    told = {**json.loads(content.pop("metadata")), **changes}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in [*content.items(), ("metadata", json.dumps(told).encode())]:
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"frameTimestamps": [1]},
        {"frameTimestamps": [1, 1, 1, 1]},
        {"frameTimestamps": [0, 1e300, 2, 3]},
        {"frameTimestamps": [{}]},
        {"frameTimestamps": None, "fps": 0},
        {"perFrameIntrinsicCoeffs": [[1, 2]]},
        {"perFrameIntrinsicCoeffs": [["a", 0, 0, 0]] * 4},
        {"perFrameIntrinsicCoeffs": [[0, 0, 0, 0]] * 4},
        {"perFrameIntrinsicCoeffs": None, "K": 3},
        {"perFrameIntrinsicCoeffs": None, "K": [1]},
    ],
)
def test_hostile_metadata_of_record3d_is_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"scan\.r3d"):
        run(metadata(tmp_path / "scan.r3d", **changes))


def test_archives_that_inflate_without_end_or_name_pictures_beyond_all(tmp_path: Path) -> None:
    path = tmp_path / "bomb.r3d"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", b" " * (41 << 20))
        archive.writestr("rgbd/0.jpg", jpeg(0))
    with pytest.raises(InputError, match="inflates to more than 40 MiB"):
        run(path)
    record3d(path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("rgbd/99999999999.jpg", jpeg(0))
    with pytest.raises(InputError, match=r"bomb\.r3d"):
        run(path)
