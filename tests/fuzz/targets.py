# SPDX-License-Identifier: Apache-2.0
"""What is fuzzed: for each reader of something from outside its good inputs, how they are spoiled, and the call.

An input is the bytes of a file or of a serialised message. A target may raise InputError and nothing else.
"""

from __future__ import annotations

import contextlib
import random
import re
import shutil
import tempfile
import typing
import zipfile
from collections.abc import Callable, Iterator
from datetime import date
from functools import cache, partial
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pye57
import yaml
from mcap.writer import CompressionType
from openpyxl import Workbook
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud
from rclpy.serialization import deserialize_message, serialize_message

from pipeprog_bringup.export.control_points import load_control_points
from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.footage.shot import Excerpt
from pipeprog_bringup.ingest import Request, ingest
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.frame_check import image_size
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.types import Cylinder
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_node.received import header as received_header
from pipeprog_node.received import images as received_images
from pipeprog_node.received import keyframes as received_keyframes
from pipeprog_node.received import maps as received_maps
from pipeprog_node.received import motion as received_motion
from pipeprog_sfm.boards.board_file import load_board_file
from tests.fuzz.attempts import Target
from tests.fuzz.fuzzed_messages import IMAGES, fuzzed_message, good_messages
from tests.fuzz.mutated_bytes import mutated
from tests.unit.bringup.footage import scans
from tests.unit.bringup.recordings import (
    START,
    camera_messages,
    coded_frames,
    info,
    jpeg,
    mcap_bytes,
    raw_image,
    ros1_bytes,
    ros1_camera_messages,
    sqlite_bytes,
    video_message,
    video_messages,
)
from tests.unit.detect.plan.ifc_site import write_plan_ifc

ROOT = Path(__file__).parents[2]
# What people and adversaries write where a number, a name or a list should stand.
SCALARS = (
    *(
        ".inf",
        ".nan",
        "-1",
        "0",
        "1e400",
        "9" * 5000,
        "0x_",
        "0x",
        "1_000",
        "!!int x",
        "!!float x",
        "2001-99-99",
        "~",
        "''",
    ),
    *(
        "!!python/object/apply:os.system [true]",
        "!!binary x",
        "!!timestamp x",
        "&a [*a]",
        "*a",
        "[",
        "{",
        "]",
        "[[[[1]]]]",
    ),
    *(
        "[" * 2000,
        "- " * 500,
        "[red]x",
        "=1+1",
        "<b>",
        "$\\frac{1}{$",
        "\x00",
        "\ufeff",
        "yes",
        "{a: 1}",
        "x" * 5000,
        "|",
    ),
    "[&a [1, 1], &b [*a, *a, *a, *a], &c [*b, *b, *b, *b], &d [*c, *c, *c, *c], &e [*d, *d, *d, *d], [*e, *e, *e, *e]]",
)
METADATA = {
    "rosbag2_bagfile_information": {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": ["part.mcap"],
        "compression_format": "",
        "compression_mode": "",
        "message_count": 16,
    }
}


def targets() -> dict[str, Target]:
    """All of them, by name."""
    files = [
        Target("bag", ".mcap", partial(_damaged, _bags), _read_bag),
        Target("sqlite", ".db3", partial(_damaged, _databases), _read_bag),
        Target("ros1", ".bag", partial(_damaged, _ros1_bags), _read_bag),
        Target("record3d", ".r3d", partial(_damaged, _archives), _ingest),
        Target("stray_odometry", ".csv", partial(_spoiled_text, _stray_tables), _ingest_stray),
        Target("polycam_camera", ".json", partial(_spoiled_text, _polycam_cameras), _ingest_polycam),
        Target("photograph", ".jpg", partial(_damaged, _photographs), _ingest_photograph),
        Target("boq", ".yaml", partial(_spoiled_text, _boqs), load_boq),
        Target("boq_csv", ".csv", partial(_spoiled_text, _bill_tables), load_boq),
        Target("boq_xlsx", ".xlsx", partial(_damaged, _workbooks), load_boq),
        Target("points", ".yaml", partial(_spoiled_text, _control_points), load_control_points),
        Target("board", ".yaml", partial(_spoiled_text, _boards), load_board_file),
        Target("calibration", ".yaml", partial(_spoiled_text, _calibrations), read_camera_file),
        Target("metadata", ".yaml", partial(_spoiled_text, _metadata), _read_folder),
        Target("image", ".jpg", partial(_damaged, _images), _read_image),
        Target("cdr", ".cdr", partial(_damaged, _recorded_messages), _read_cdr),
    ]
    if find_spec("av") is not None:
        files.append(Target("video", ".mcap", partial(_damaged, _videos), _read_bag))
    if find_spec("ifcopenshell") is not None:
        files.append(Target("ifc", ".ifc", partial(_spoiled_text, _ifc_plans), load_boq))
    clouds = [Target(name, f".{name}", partial(_damaged, partial(_clouds, name)), read_cloud) for name in CLOUDS]
    types: dict[str, Any] = {type(message).__name__: type(message) for message in good_messages(0).values()}
    doors = [
        Target(f"message {name}", ".cdr", partial(_message, message_type), partial(_read_message, message_type))
        for name, message_type in sorted(types.items())
        if _checks(message_type)
    ]
    return {target.name: target for target in (*files, *clouds, *doors)}


def _damaged(seeds: Callable[[], list[bytes]], rng: random.Random) -> bytes:
    return mutated(rng.choice(seeds()), rng)


def _spoiled_text(seeds: Callable[[], list[bytes]], rng: random.Random) -> bytes:
    """A text with words in other places, or in their place what no reader expects; at times with damaged bytes."""
    data = rng.choice(seeds())
    if rng.random() < 0.2:
        return mutated(data, rng)
    words = re.split(rb"([\w.+-]+)", data)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(words))
        words[at] = rng.choice((rng.choice(SCALARS).encode(), rng.choice(words), b"", words[at] * rng.choice((2, 300))))
    return b"".join(words)


@cache
def _bags() -> list[bytes]:
    """Recordings in chunks of every compression and in none, with and without checksums."""
    motion = [
        (topic, type_name, START + 10 * number, serialize_message(good_messages(number)[name]))
        for number in range(2)
        for topic, type_name, name in (
            ("/odom", cdr.ODOMETRY, "odometry"),
            ("/imu", cdr.IMU, "imu"),
            ("/tf", cdr.TF, "/tf"),
            ("/tf_static", cdr.TF, "/tf_static"),
        )
    ]
    messages = camera_messages(3) + motion
    raw = [
        (topic, cdr.IMAGE, at, raw_image(0)) if "image" in topic else (topic, kind, at, data)
        for topic, kind, at, data in camera_messages(2)
    ]
    bags = [
        mcap_bytes(messages, compression, enable_crcs=crc) for compression in CompressionType for crc in (True, False)
    ]
    return [*bags, mcap_bytes(messages, use_chunking=False), mcap_bytes(raw, CompressionType.NONE, enable_crcs=False)]


@cache
def _bill_tables() -> list[bytes]:
    english = "name,outer diameter [mm],planned length [m],zone\nA,60.3,1906.5,1\nB,114.3,8.60,2\n"
    german = "Bezeichnung;Durchmesser (mm);L\u00e4nge (m);Beginn\nA;60,3;1.906,5;1.3.2026\nB;114,3;8,60;\n"
    return [english.encode(), german.encode("utf-8-sig")]


@cache
def _control_points() -> list[bytes]:
    rows = [f"- {{name: P{k}, circle: A/{k}, xyz: [{k}, 2, 3.5]}}" for k in range(1, 5)]
    circles = "\n".join(["points:", *rows, ""])
    return [circles.encode(), f"{circles}- {{name: P5, pixel: [[1, 2.5, 3], [2, 4, 5]], xyz: [1, 2, 3]}}\n".encode()]


@cache
def _ifc_plans() -> list[bytes]:
    """Plans with bodies of their own and with mapped ones."""
    pipes = [
        (name, "DN100", Cylinder(np.array([k, 0.0, 0.0]), np.array([k + 2.0, 0.0, 1.0]), 0.05715))
        for k, name in enumerate(("a", "b"))
    ]
    content = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.ifc"
        for mapped in (False, True):
            write_plan_ifc(path, pipes, mapped=mapped, systems={"a": "heating", "b": "water"})
            content.append(path.read_bytes())
    return content


@cache
def _workbooks() -> list[bytes]:
    """Workbooks with their parts inflated, so that damage reaches the reader behind the archive, and as saved."""
    content = []
    for compression in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        book = Workbook()
        for row in (
            ("name", "outer diameter [mm]", "planned length [m]", "start"),
            ("A", 60.3, 24.5, date(2026, 3, 2)),
        ):
            book.active.append(row)
        saved = BytesIO()
        book.save(saved)
        again = BytesIO()
        with zipfile.ZipFile(saved) as archive, zipfile.ZipFile(again, "w", compression) as copy:
            for name in archive.namelist():
                copy.writestr(name, archive.read(name))
        content.append(again.getvalue())
    return content


@cache
def _databases() -> list[bytes]:
    return [sqlite_bytes(camera_messages(3)), sqlite_bytes(camera_messages(1))]


@cache
def _archives() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [scans.record3d(Path(folder, "scan.r3d")).read_bytes()]


@cache
def _stray_tables() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [Path(scans.stray(Path(folder, "scan")), "odometry.csv").read_bytes()]


@cache
def _polycam_cameras() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        cameras = scans.polycam(Path(folder, "scan")) / "keyframes" / "corrected_cameras"
        return [sorted(cameras.iterdir())[0].read_bytes()]


@cache
def _photographs() -> list[bytes]:
    return [scans.photograph("2026:11:02 10:00:00", "25", 26, turned) for turned in (1, 6)]


@cache
def _ros1_bags() -> list[bytes]:
    kinds = (("none", True), ("none", False), ("bz2", True), ("lz4", False))
    return [ros1_bytes(ros1_camera_messages(3), compression, index, 3) for compression, index in kinds]


@cache
def _videos() -> list[bytes]:
    """Recordings of coded frames, neither compressed nor checked, so that damage reaches the decoder."""
    kinds = (("libx264", cdr.COMPRESSED_VIDEO), ("libx265", cdr.FFMPEG_PACKET), ("libx264", cdr.COMPRESSED_IMAGE))
    return [
        mcap_bytes(
            video_messages(coded_frames(6, encoder, key_every=3), type_name, encoder),
            CompressionType.NONE,
            enable_crcs=False,
        )
        for encoder, type_name in kinds
    ]


@cache
def _boqs() -> list[bytes]:
    sizes = b"classes:\n  - {name: A, size: DN 100, planned_length_m: 3}\n"
    diameters = b"classes:\n  - {name: B, outer_diameter_mm: 60, planned_length_m: 2, color: '#ff8800'}\n"
    return [(ROOT / "bags" / "demo.boq.yaml").read_bytes(), sizes, diameters]


@cache
def _boards() -> list[bytes]:
    board = (ROOT / "bags" / "demo.board.yaml").read_bytes()
    distances = b"distances:\n  - {from: A/1, to: A/2, distance_mm: 480.2, sigma_mm: 0.5}\n"
    marks = b"marks:\n  - {circle_radius_mm: 50, distance_mm: 2134, sigma_mm: 1.5}\n"
    return [board, board + distances, marks, board + marks]


@cache
def _calibrations() -> list[bytes]:
    content = {
        "image_width": 160,
        "image_height": 96,
        "camera_name": "phone",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [150.0, 0, 79.5, 0, 150.0, 47.5, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, -0.05, 0, 0, 0]},
        "readout": 0.015,
    }
    return [yaml.safe_dump(content).encode()]


@cache
def _metadata() -> list[bytes]:
    return [yaml.safe_dump(METADATA).encode()]


@cache
def _images() -> list[bytes]:
    noise = np.random.default_rng(0).integers(0, 256, (96, 128), np.uint8)
    progressive = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    return [jpeg(0), jpeg(1, 128, 96), progressive, cv2.imencode(".png", noise)[1].tobytes(), *IMAGES]


@cache
def _recorded_messages() -> list[bytes]:
    video = [video_message(name, 0, b"\0\0\1\x65") for name in (cdr.COMPRESSED_VIDEO, cdr.FFMPEG_PACKET)]
    return [data for *_, data in camera_messages(2)] + [info(0), raw_image(0), *video]


CLOUDS = ("ply", "pcd", "las", "laz", "e57", "xyz", "csv")


@cache
def _clouds(suffix: str) -> list[bytes]:
    """Small clouds of one format, each of its encodings."""
    points = np.random.default_rng(0).normal(0, 2, (50, 3)).astype(np.float32).astype(float)
    with tempfile.TemporaryDirectory() as folder:
        return [path.read_bytes() for path in _write_clouds(suffix, Path(folder), points)]


def _write_clouds(suffix: str, folder: Path, points: np.ndarray) -> Iterator[Path]:
    path = folder / f"cloud.{suffix}"
    if suffix == "ply":
        vertices = np.array([(*point, 7) for point in points], [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u2")])
        for text, order in ((False, "<"), (False, ">"), (True, "=")):
            PlyData([PlyElement.describe(vertices, "vertex")], text=text, byte_order=order).write(str(path))
            yield path
    elif suffix == "pcd":
        for encoding in Encoding:
            PointCloud.from_xyzi_points(np.c_[points, np.ones(len(points))]).save(path, encoding=encoding)
            yield path
    elif suffix in ("las", "laz"):
        for point_format, version in ((3, "1.2"), (7, "1.4")):  # compressed as one stream, and in layers
            las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
            las.x, las.y, las.z = points.T
            las.write(path)
            yield path
    elif suffix == "e57":
        file = pye57.E57(str(path), mode="w")
        file.write_scan_raw({f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")})
        file.close()
        yield path
    else:
        for head in ("", "x,y,z,nx,ny,nz\n", "# plain\n50\n"):
            path.write_text(head + "".join(f"{x:.4f},{y:.4f},{z:.4f},0,0,1\n" for x, y, z in points))
            yield path


def _message(message_type: Any, rng: random.Random) -> bytes:
    return fuzzed_message(_samples(message_type), rng).cdr


@cache
def _samples(message_type: Any) -> list[Any]:
    return [one for number in range(3) for one in good_messages(number).values() if type(one) is message_type]


@cache
def _checks(message_type: Any) -> list[Callable[[Any], object]]:
    """The functions of the room `received` that take messages of this type."""
    found = []
    modules = received_header, received_images, received_keyframes, received_maps, received_motion
    for name, function in [item for module in modules for item in vars(module).items()]:
        own = getattr(function, "__module__", "").startswith("pipeprog_node.received.")
        if not own or name.startswith("_") or isinstance(function, type) or function in found:
            continue
        hints = [hint for name, hint in typing.get_type_hints(function).items() if name != "return"]
        if len(hints) == 1 and hints[0] is message_type:
            found.append(function)
    return found


def _read_message(message_type: Any, path: Path) -> None:
    try:
        message = deserialize_message(path.read_bytes(), message_type)
    except Exception:  # RMWError, which rclpy does not export: the middleware drops such bytes
        return
    for check in _checks(message_type):
        with contextlib.suppress(InputError):
            check(message)


def _read_cdr(path: Path) -> None:
    """As each kind of message that is read by hand; ValueError says that it is damaged."""
    data = path.read_bytes()
    with contextlib.suppress(ValueError, InputError):
        cdr.read_camera_info(data).camera()
    for type_name in (cdr.COMPRESSED_VIDEO, cdr.FFMPEG_PACKET):
        with contextlib.suppress(ValueError):
            cdr.read_image(data, type_name)
    for type_name in (cdr.IMAGE, cdr.COMPRESSED_IMAGE):
        with contextlib.suppress(ValueError, InputError):
            image_size(cdr.read_image(data, type_name), type_name)


def _read_bag(path: Path) -> None:
    bag = Bag.open(path)
    for message in bag.with_motion():
        del message
    bag.losses  # noqa: B018 - a property that walks


def _ingest(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        ingest(Request(path, None, Path(folder, "bag.mcap"), Excerpt()), lambda share, text: None)


def _ingest_stray(path: Path) -> None:
    """An odometry.csv in a scan that is right."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, scans.stray(Path(folder, "scan")) / "odometry.csv")
        _ingest(Path(folder, "scan"))


def _ingest_polycam(path: Path) -> None:
    """One camera's file in a scan that is right."""
    with tempfile.TemporaryDirectory() as folder:
        cameras = scans.polycam(Path(folder, "scan")) / "keyframes" / "corrected_cameras"
        shutil.copy(path, sorted(cameras.iterdir())[0])
        _ingest(Path(folder, "scan"))


def _ingest_photograph(path: Path) -> None:
    """A picture beside one that is right."""
    with tempfile.TemporaryDirectory() as folder:
        pictures = Path(folder, "pictures")
        pictures.mkdir()
        (pictures / "0.jpg").write_bytes(_photographs()[0])
        shutil.copy(path, pictures / "1.jpg")
        _ingest(pictures)


def _read_folder(path: Path) -> None:
    """The metadata.yaml of a rosbag2 folder, with one whole recording beside it."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, Path(folder, "metadata.yaml"))
        Path(folder, "part.mcap").write_bytes(_bags()[0])
        _read_bag(Path(folder))


def _read_image(path: Path) -> None:
    """Size from the header, then the pixels, as the selector decodes them."""
    encoded = path.read_bytes()
    decode_reduced(encoded, encoded_size(encoded)[0])
