# SPDX-License-Identifier: Apache-2.0
"""Raw data of Polycam (iOS with LiDAR, developer mode): pictures, cameras, depth and confidence by their times.

The corrected pictures are taken where the app has made them: those are without distortion, and their poses went
through a loop closure. Format: PolyCam/polyform, README.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.footage import arkit
from pipeprog_bringup.footage.shot import UNDATED, Excerpt, Shot
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.files.text_file import read_bytes
from pipeprog_camera.limits import MAX_ENCODED_IMAGE, MAX_POSES

_MICROSECOND = 1000  # ns
_HIGHEST_CONFIDENCE = 255


class Polycam:
    """The pictures of a capture's folder; raises InputError where it has none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        folder = path / "keyframes"
        kind = "corrected_" if (folder / "corrected_images").is_dir() else ""
        self._cameras, self._folder = folder / f"{kind}cameras", folder
        names = {file.stem: file for file in (folder / f"{kind}images").glob("*.jpg") if _is_time(file.stem)}
        self._pictures = [names[stem] for stem in sorted(names, key=int)]
        if not 0 < len(self._pictures) <= MAX_POSES:
            raise InputError(f"{folder} holds {len(names)} pictures: export the capture's raw data again")
        self.expected = len(self._pictures)
        self.notes = [] if kind else [f"{path} has no corrected images: the lens' distortion is left as it is"]

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The pictures with their poses; stamps begin at 1 s, since the app counts from when the phone was started."""
        first = int(self._pictures[0].stem)
        left_out = 0
        for picture in self._pictures:
            time = (int(picture.stem) - first) * _MICROSECOND
            if not excerpt.wants(1e-9 * time):
                continue
            try:
                yield self._shot(picture, UNDATED + time)
            except InputError:
                left_out += 1
        if left_out == len(self._pictures):
            raise InputError(f"{self.path}: none of its pictures has a camera that can be read: export it again")
        if left_out:
            self.notes.append(f"{self.path}: {left_out} pictures left out: damaged, or without their camera")

    def _shot(self, picture: Path, stamp: int) -> Shot:
        encoded = read_bytes(picture, MAX_ENCODED_IMAGE)
        told = read_json(self._cameras / f"{picture.stem}.json")
        camera = arkit.pinhole(encoded_size(encoded), *(told.get(key) for key in ("fx", "fy", "cx", "cy")))
        rows = np.array([[_number(told, f"t_{row}{column}") for column in range(4)] for row in range(3)])
        pose = arkit.WORLD_FROM_ARKIT @ arkit.pose_of_rows(rows) @ arkit.ARKIT_FROM_OPTICAL
        depth, confidence = (self._beside(kind, picture.stem) for kind in ("depth", "confidence"))
        return Shot(
            stamp,
            encoded,
            camera,
            pose,
            None if depth is None else arkit.depth_image(depth),
            None if confidence is None else arkit.confidence_image(confidence, _HIGHEST_CONFIDENCE),
        )

    def _beside(self, kind: str, stem: str) -> bytes | None:
        file = self._folder / kind / f"{stem}.png"
        return read_bytes(file, MAX_ENCODED_IMAGE) if file.is_file() else None


def _is_time(stem: str) -> bool:
    return stem.isascii() and stem.isdigit() and len(stem) <= 16


def _number(told: dict[str, Any], key: str) -> float:
    value = told.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{key} is missing")
    return float(value)
