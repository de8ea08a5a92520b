# SPDX-License-Identifier: Apache-2.0
"""Small recordings of scanning apps: four pictures of a walk along x, made as the apps make them."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.unit.bringup.recordings import CAMERA, STEP, jpeg, pictures

COUNT = 4
# In ROS's axes: looking along y, level, a decimetre further along x with each picture.
OPTICAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
ARKIT_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FLIP = np.diag([1.0, -1, -1])
DEPTH = np.arange(96 * 128, dtype=np.uint16).reshape(96, 128) + 1000  # mm


def world_from_camera(number: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = OPTICAL, (0.1 * number, 2.0, 1.5)
    return pose


def focal(number: int) -> float:
    """Focal length [px] of a picture: autofocus changes it."""
    return CAMERA.fx + number


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def polycam(folder: Path) -> Path:
    for kind in ("corrected_images", "corrected_cameras", "depth", "confidence"):
        (folder / "keyframes" / kind).mkdir(parents=True)
    for number in range(COUNT):
        name = str(77_000_000 + number * STEP // 1000)
        pose = world_from_camera(number)
        rotation = ARKIT_FROM_WORLD @ pose[:3, :3] @ FLIP
        rows = np.c_[rotation, ARKIT_FROM_WORLD @ pose[:3, 3]]
        camera = {f"t_{row}{column}": rows[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": focal(number), "fy": focal(number), "cx": CAMERA.cx, "cy": CAMERA.cy}
        inside = folder / "keyframes"
        (inside / "corrected_images" / f"{name}.jpg").write_bytes(jpeg(number))
        (inside / "corrected_cameras" / f"{name}.json").write_text(json.dumps(camera))
        (inside / "depth" / f"{name}.png").write_bytes(png(DEPTH))
        (inside / "confidence" / f"{name}.png").write_bytes(png(np.full((96, 128), 127 * (number % 3), np.uint8)))
    return folder


def stray(folder: Path) -> Path:
    for kind in ("depth", "confidence"):
        (folder / kind).mkdir(parents=True)
    writer = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60.0, (64, 48))
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy"]
    for number, picture in enumerate(pictures(COUNT)):
        writer.write(picture)
        pose = world_from_camera(number)
        quaternion = Rotation.from_matrix(ARKIT_FROM_WORLD @ pose[:3, :3]).as_quat()
        numbers = [*(ARKIT_FROM_WORLD @ pose[:3, 3]), *quaternion, *[focal(number)] * 2, CAMERA.cx, CAMERA.cy]
        rows.append(f"{4321.5 + number * STEP * 1e-9:.6f}, {number:06d}, " + ", ".join(f"{one:.9f}" for one in numbers))
        (folder / "depth" / f"{number:06d}.png").write_bytes(png(DEPTH))
        (folder / "confidence" / f"{number:06d}.png").write_bytes(png(np.full((96, 128), number % 3, np.uint8)))
    writer.release()
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    k = CAMERA.matrix
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(str(one) for one in row) for row in k))
    return folder


def record3d(path: Path) -> Path:
    told = {
        "K": CAMERA.matrix.T.ravel().tolist(),
        "w": 64,
        "h": 48,
        "fps": 60,
        "poses": [[0, 0, 0, 1, 0.1 * number, 0, 0] for number in range(COUNT)],
        "perFrameIntrinsicCoeffs": [[focal(number), focal(number), CAMERA.cx, CAMERA.cy] for number in range(COUNT)],
        "frameTimestamps": [4321.5 + number * STEP * 1e-9 for number in range(COUNT)],
    }
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(COUNT):
            archive.writestr(f"rgbd/{number}.jpg", jpeg(number))
            archive.writestr(f"rgbd/{number}.depth", b"bvx2")
        archive.writestr("metadata", json.dumps(told))
    return path


def photograph(taken: str = "", fraction: str = "", focal: int = 0, turned: int = 1, width: int = 160) -> bytes:
    """A JPEG with what EXIF tells of it; nothing where a value is empty."""
    tags = Image.Exif()
    own = tags.get_ifd(0x8769)
    for tag, value in ((0x9003, taken), (0x9291, fraction), (0xA405, focal)):
        if value:
            own[tag] = value
    tags[0x0112] = turned
    stream = io.BytesIO()
    picture = np.tile(np.arange(width, dtype=np.uint8), (96, 1))
    Image.fromarray(np.stack([picture] * 3, -1)).save(stream, "JPEG", exif=tags)
    return stream.getvalue()
