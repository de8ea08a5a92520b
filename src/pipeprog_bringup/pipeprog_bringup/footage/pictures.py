# SPDX-License-Identifier: Apache-2.0
"""A folder of photographs (JPEG): when each was taken, and through which lens, by their EXIF."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeprog_bringup.footage.shot import UNDATED, Excerpt, Shot
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_bytes
from pipeprog_camera.limits import MAX_ENCODED_IMAGE, MAX_POSES

_EXIF, _TAKEN, _FRACTION, _FOCAL_35MM, _ORIENTATION = 0x8769, 0x9003, 0x9291, 0xA405, 0x0112
_FOCAL_LENGTHS = (8.0, 500.0)  # mm of 35 mm film that a camera can have: from fisheye to tele lenses
_STEP = 100_000_000  # ns between photographs of one second whose cameras tell no fraction of it
_UNTIMED_STEP = 1_000_000_000  # ns, where some have no time: a person takes one a second


@dataclass(frozen=True)
class Exif:
    """What a photograph says of itself: time [ns, by the camera's clock], focal length [mm of 35 mm film], turned."""

    taken: int | None = None
    focal_length: float | None = None
    is_turned: bool = False


class Pictures:
    """The photographs in a folder and their camera; raises InputError where there are none."""

    def __init__(self, path: Path, camera: Camera) -> None:
        self.path = path
        self._camera = camera
        self._files = picture_files(path)
        self.expected = len(self._files)
        self.notes: list[str] = []

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The photographs in the order in which they were taken, in that of their names where some have no time."""
        told = [read_exif(read_bytes(file, MAX_ENCODED_IMAGE)) for file in self._files]
        times = [exif.taken for exif in told if exif.taken is not None]
        if len(times) < len(self._files):
            times = [UNDATED + number * _UNTIMED_STEP for number in range(len(self._files))]
            self.notes.append(f"{self.path}: not all pictures tell when they were taken: taken by name, one a second")
        first, last, left_out = min(times), min(times) - _STEP, 0
        for time, _, file, exif in sorted(zip(times, range(len(told)), self._files, told, strict=True)):
            last = time if time > last else last + _STEP
            if not excerpt.wants(1e-9 * (last - first)):
                continue
            data = read_bytes(file, MAX_ENCODED_IMAGE)
            try:
                if encoded_size(data) != (self._camera.width, self._camera.height):
                    raise InputError("of another size")
                picture = _as_the_sensor_saw_it(data) if exif.is_turned else data
            except InputError:
                left_out += 1
                continue
            yield Shot(last, picture, self._camera)
        if left_out:
            size = f"{self._camera.width} x {self._camera.height}"
            self.notes.append(f"{self.path}: {left_out} pictures left out: damaged, or not of {size}")


def picture_files(path: Path) -> list[Path]:
    """The JPEG files of a folder in the order of the numbers in their names; InputError without any."""
    files = [file for file in path.iterdir() if file.suffix.lower() in (".jpg", ".jpeg") and file.is_file()]
    if not 0 < len(files) <= MAX_POSES:
        raise InputError(f"{path} holds {len(files)} JPEG pictures: give a folder with 1 to {MAX_POSES}")
    return sorted(files, key=lambda file: [(len(part), part) for part in re.findall(r"\d+|\D+", file.name)])


def read_exif(data: bytes) -> Exif:
    """What JPEG bytes say of themselves; nothing where they are damaged."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, of tags that are cut off
            with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
                tags = image.getexif()
                own = dict(tags.get_ifd(_EXIF))
                turned = tags.get(_ORIENTATION, 1)
    except Exception:  # Pillow raises exceptions of many types for damaged headers
        return Exif()
    return Exif(_taken(own), _focal_length(own.get(_FOCAL_35MM)), isinstance(turned, int) and turned > 1)


def _taken(tags: dict[int, Any]) -> int | None:
    try:
        moment = datetime.strptime(str(tags[_TAKEN]), "%Y:%m:%d %H:%M:%S").replace(tzinfo=timezone.utc)
    except (KeyError, ValueError):
        return None
    fraction = str(tags.get(_FRACTION, "")).strip()
    nanoseconds = int(fraction[:9].ljust(9, "0")) if fraction.isascii() and fraction.isdigit() else 0
    seconds = int(moment.timestamp())
    return seconds * 1_000_000_000 + nanoseconds if seconds > 0 else None


def _focal_length(value: Any) -> float | None:
    try:
        length = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return length if _FOCAL_LENGTHS[0] <= length <= _FOCAL_LENGTHS[1] else None


def _as_the_sensor_saw_it(data: bytes) -> NDArray[np.uint8]:
    """(H, W, 3) without the turn that viewers are asked to make: the calibration is of the picture as it is stored."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError("damaged")
    return np.asarray(image, np.uint8)
