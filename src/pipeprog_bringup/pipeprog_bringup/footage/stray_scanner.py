# SPDX-License-Identifier: Apache-2.0
"""Folders of Stray Scanner (iOS with LiDAR): a video, a row of odometry.csv for each of its pictures, depth beside it.

Poses are in ARKit's world, of a camera whose y points down and whose z points ahead (StrayScanner's OdometryEncoder
turns ARKit's by half a turn about x). Newer versions of the app write the intrinsics of each picture.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeprog_bringup.footage import arkit
from pipeprog_bringup.footage.shot import Excerpt, Shot
from pipeprog_bringup.footage.video import Video, picture_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_bytes, read_text
from pipeprog_camera.limits import MAX_ENCODED_IMAGE, MAX_POSES, MAX_SECONDS, MAX_TABLE

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_HIGHEST_CONFIDENCE = 2


class StrayScanner:
    """The pictures of a scan's folder; raises InputError where its parts are missing or do not belong together."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows = _rows(path / "odometry.csv")
        size = picture_size(path / "rgb.mp4")
        matrix = _matrix(path / "camera_matrix.csv")
        camera = arkit.pinhole(size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        self._video = Video(path / "rgb.mp4", camera, path / "camera_matrix.csv")
        self.expected = len(self._rows)
        self.notes = self._video.notes

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The pictures with their poses; stamps are the times of the app, from the date of the video on."""
        first = self._rows[0]["timestamp"]
        start: int | None = None
        count = 0
        for number, shot in enumerate(self._video.shots(Excerpt())):
            start = shot.stamp if start is None else start
            if number >= len(self._rows):
                break
            row = self._rows[number]
            seconds = row["timestamp"] - first
            if not excerpt.wants(seconds):
                continue
            count += 1
            yield self._shot(shot, row, start + round(seconds * 1e9))
        if number + 1 != len(self._rows):
            self.notes.append(f"{self.path}: odometry.csv has {len(self._rows)} rows for {number + 1} pictures")

    def _shot(self, shot: Shot, row: dict[str, float], stamp: int) -> Shot:
        """The picture with what the app tells of it; raises InputError where that is nothing of a camera."""
        camera = shot.camera
        try:
            if all(np.isfinite(row.get(key, np.nan)) for key in _INTRINSICS):
                camera = arkit.pinhole((camera.width, camera.height), *(row[key] for key in _INTRINSICS))
            pose = arkit.WORLD_FROM_ARKIT @ arkit.pose_of_quaternion(
                [row[key] for key in _POSE[:3]], [row[key] for key in _POSE[3:]]
            )
        except InputError as error:
            raise InputError(f"{self.path / 'odometry.csv'}, frame {row['frame']:.0f}: {error}") from None
        depth, confidence = (self._beside(kind, int(row["frame"])) for kind in ("depth", "confidence"))
        return replace(
            shot,
            stamp=stamp,
            camera=camera,
            world_from_camera=pose,
            depth=None if depth is None else arkit.depth_image(depth),
            confidence=None if confidence is None else arkit.confidence_image(confidence, _HIGHEST_CONFIDENCE),
        )

    def _beside(self, kind: str, frame: int) -> bytes | None:
        file = self.path / kind / f"{frame:06d}.png"
        return read_bytes(file, MAX_ENCODED_IMAGE) if file.is_file() else None


def _rows(path: Path) -> list[dict[str, float]]:
    """The rows of odometry.csv, whose times rise; a last one that is cut off is left out."""
    text = read_text(path, MAX_TABLE)
    reader = csv.DictReader(text[: text.rfind("\n") + 1].splitlines(), skipinitialspace=True)
    needed = {"timestamp", "frame", *_POSE}
    if not needed <= set(reader.fieldnames or ()):
        raise InputError(f"{path} has not the columns of Stray Scanner ({', '.join(sorted(needed))}): copy it again")
    rows: list[dict[str, float]] = []
    for row in reader:
        try:
            found = {key: float(row[key]) for key in {*needed, *_INTRINSICS} if row.get(key)}
        except (TypeError, ValueError):
            break
        if not needed <= set(found) or not np.isfinite(list(found.values())).all():
            break
        if not 0 <= found["timestamp"] < MAX_SECONDS or not 0 <= found["frame"] < MAX_POSES or len(rows) >= MAX_POSES:
            raise InputError(f"{path}, line {reader.line_num}: no time or number of a picture: copy it again")
        if rows and found["timestamp"] <= rows[-1]["timestamp"]:
            raise InputError(f"{path}, line {reader.line_num}: its time is not after the one before: copy it again")
        rows.append(found)
    if not rows:
        raise InputError(f"{path} has no row of a picture: copy it again")
    return rows


def _matrix(path: Path) -> np.ndarray:
    """(3, 3) of camera_matrix.csv."""
    try:
        matrix = np.array(
            [[float(value) for value in row] for row in csv.reader(read_text(path, MAX_TABLE).splitlines())]
        )
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape != (3, 3):
        raise InputError(f"{path} is no matrix of three rows of three numbers: copy it again")
    return matrix
