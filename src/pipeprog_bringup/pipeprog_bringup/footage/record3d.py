# SPDX-License-Identifier: Apache-2.0
"""Recordings of Record3D (.r3d, an archive): JPEG pictures with the intrinsics of each, which its stabiliser changes.

Poses are left out, since they begin with the identity however the phone was held: as odometry they would tell a wrong
vertical. So is depth, which is compressed by LZFSE.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeprog_bringup.footage import arkit
from pipeprog_bringup.footage.shot import UNDATED, Excerpt, Shot
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import parse_json
from pipeprog_camera.limits import MAX_ENCODED_IMAGE, MAX_JSON, MAX_POSES, MAX_VIDEO_SECONDS

_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, KeyError)


class Record3D:
    """The pictures of a recording; raises InputError where it is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except _DAMAGED:
            raise InputError(f"{path} is cut off or no archive of Record3D: share it from the app again") from None
        names = {name.removeprefix("rgbd/").removesuffix(".jpg"): name for name in self._archive.namelist()}
        self._pictures = {int(stem): name for stem, name in names.items() if stem.isascii() and stem.isdigit()}
        self._told = self._metadata()
        if not 0 < len(self._pictures) <= MAX_POSES:
            raise InputError(f"{path} holds {len(self._pictures)} pictures: share it from the app again")
        self.expected = len(self._pictures)
        self.notes = [f"{path}: poses and depth of Record3D are not taken"]

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The pictures in their order; stamps begin at 1 s."""
        times = [self._time(number) for number in range(max(self._pictures) + 1)]
        left_out, last = 0, -1.0
        for number in sorted(self._pictures):
            seconds = times[number] - times[0]
            if not last < seconds < MAX_VIDEO_SECONDS:
                raise InputError(f"{self.path}: the time of picture {number} is not after the one before")
            last = seconds
            if not excerpt.wants(seconds):
                continue
            try:
                encoded = self._read(self._pictures[number], MAX_ENCODED_IMAGE)
                size = encoded_size(encoded)
            except (InputError, *_DAMAGED):
                left_out += 1
                continue
            yield Shot(UNDATED + round(seconds * 1e9), encoded, self._camera(number, size))
        if left_out:
            self.notes.append(f"{self.path}: {left_out} pictures left out: damaged")

    def _metadata(self) -> dict[str, Any]:
        try:
            text = self._read("metadata", MAX_JSON).decode()
        except (UnicodeDecodeError, *_DAMAGED):
            raise InputError(f"{self.path} has no metadata of Record3D that can be read: share it again") from None
        return parse_json(text, f"{self.path}: metadata")

    def _read(self, name: str, most: int) -> bytes:
        """A member of the archive; raises InputError where it is larger than any."""
        with self._archive.open(name) as member:
            data = member.read(most + 1)
        if len(data) > most:
            raise InputError(f"{self.path}: {name} inflates to more than {most >> 20} MiB")
        return data

    def _time(self, number: int) -> float:
        """Seconds of a picture, by its stamp or the rate."""
        stamps, rate = self._told.get("frameTimestamps"), self._told.get("fps", 30)
        try:
            return float(stamps[number]) if isinstance(stamps, list) and stamps else number / float(rate)
        except (IndexError, TypeError, ValueError, ZeroDivisionError):
            raise InputError(f"{self.path}: metadata has no time of picture {number}: share it again") from None

    def _camera(self, number: int, size: tuple[int, int]) -> Camera:
        """The intrinsics of a picture, those of all where it has none of its own."""
        each, k = self._told.get("perFrameIntrinsicCoeffs"), self._told.get("K")
        try:
            if isinstance(each, list) and each:
                return arkit.pinhole(size, *each[number][:4])
            return arkit.pinhole(size, k[0], k[4], k[6], k[7])  # type: ignore[index]
        except (IndexError, TypeError):
            raise InputError(f"{self.path}: metadata has no intrinsics of picture {number}: share it again") from None
        except InputError as error:
            raise InputError(f"{self.path}: picture {number}: {error}") from None
