# SPDX-License-Identifier: Apache-2.0
"""A video file: its pictures under the times that they have in it, from when it was filmed on.

Motion JPEG is taken as it is; of all other codecs the pictures are decoded.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.footage.quicktime import Movie, read_movie
from pipeprog_bringup.footage.shot import UNDATED, Excerpt, Shot
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import check_size, encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_VIDEO_SECONDS

_ERRORS = 2  # OpenCV's number for messages of errors alone
# Containers that cameras write; FFmpeg's names.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg,mxf,mjpeg,h264,hevc"
_PICTURES = (".jpg", ".jpeg", ".png", ".heic")
_HUFFMAN_TABLES = b"\xff\xc4"  # which some cameras leave out of their motion JPEG


class Video:
    """A video and the camera of its pictures; raises InputError where they do not belong together."""

    def __init__(self, path: Path, calibrated: Camera, camera_yaml: Path) -> None:
        self.path = path
        self._capture = _open(path)
        self._camera, self.notes = _fit(self._capture, calibrated, path, camera_yaml)
        self.expected = int(_property(self._capture, cv2.CAP_PROP_FRAME_COUNT))
        movie = read_movie(path)
        self._start = UNDATED if movie.created is None else movie.created
        self.notes += _colour_notes(path, movie)

    @property
    def seconds(self) -> float:
        """How long it lasts, as its container says; 0: it does not say."""
        rate = _property(self._capture, cv2.CAP_PROP_FPS)
        return self.expected / rate if rate > 0 and self.expected > 0 else 0.0

    def shots(self, excerpt: Excerpt) -> Iterator[Shot]:
        """The pictures; where the container has no time of a day for one, its rate stands in."""
        self._take_jpeg_as_it_is()
        rate = _property(self._capture, cv2.CAP_PROP_FPS)
        step = round(1e9 / rate) if 0.01 <= rate < 1000 else 33_333_333  # ns; from time lapses to high speed
        last, count, over = -step, 0, False
        while not over and self._capture.grab():
            seconds = 1e-3 * _property(self._capture, cv2.CAP_PROP_POS_MSEC)
            time = round(seconds * 1e9) if 0 <= seconds < MAX_VIDEO_SECONDS else last
            last = time if time > last else last + step
            count += 1
            over = excerpt.is_over(1e-9 * last)
            if not excerpt.wants(1e-9 * last):
                continue
            ok, image = self._capture.retrieve()
            if not ok:
                break
            yield Shot(self._start + last, self._checked(image, count), self._camera)
        self._capture.release()
        if not count:
            raise InputError(f"{self.path} holds no frame that can be decoded: convert it to H.264 in an .mp4 file")
        # Containers overstate the number of frames by one or two; where more are missing, the video was cut off.
        if not over and count < 0.98 * self.expected - 2:
            self.notes.append(f"{self.path} ends early: {count} of {self.expected} frames could be read")

    def _take_jpeg_as_it_is(self) -> None:
        """Have OpenCV give the JPEGs of motion JPEG where they are whole and not to be turned."""
        if int(_property(self._capture, cv2.CAP_PROP_FOURCC)).to_bytes(4, "little") != b"MJPG":
            return
        if _property(self._capture, cv2.CAP_PROP_ORIENTATION_META):
            return
        probe = _open(self.path)
        probe.set(cv2.CAP_PROP_FORMAT, -1)
        ok, packet = probe.read()
        probe.release()
        if ok and packet is not None and _HUFFMAN_TABLES in packet.tobytes():
            self._capture.set(cv2.CAP_PROP_FORMAT, -1)

    def _checked(self, image: NDArray[np.uint8], number: int) -> bytes | NDArray[np.uint8]:
        """The picture, once its size is the camera's."""
        encoded = image.tobytes() if image.ndim == 2 and image.shape[0] == 1 else b""
        try:
            width, height = encoded_size(encoded) if encoded else (image.shape[1], image.shape[0])
        except InputError as error:
            raise InputError(f"{self.path}: frame {number}: {error}: cut the video there") from None
        if (width, height) != (self._camera.width, self._camera.height):
            raise InputError(
                f"{self.path}: frame {number} is {width} x {height}, those before it "
                f"{self._camera.width} x {self._camera.height}: cut the video there"
            )
        return encoded or image


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] of a video's pictures, as the sensor saw them; raises InputError where it is none."""
    capture = _open(path)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0.0)
    size = int(_property(capture, cv2.CAP_PROP_FRAME_WIDTH)), int(_property(capture, cv2.CAP_PROP_FRAME_HEIGHT))
    capture.release()
    check_size(*size)
    return size


def _colour_notes(path: Path, movie: Movie) -> list[str]:
    """What becomes of colours that JPEG has not."""
    if not movie.transfer and movie.bits == 8:
        return []
    kind = " ".join([f"{movie.bits} bit"] + [movie.transfer] * bool(movie.transfer))
    return [f"{path} has {kind} colours: taken as 8 bit without tone mapping, which looks flat and measures the same"]


def _open(video: Path) -> Any:
    if not video.exists():
        raise InputError(f"no such video: {video}")
    if not video.is_file():
        raise InputError(f"{video} is a folder, a device or a pipe: give a video file")
    # FFmpeg's own messages on stderr are switched off: the errors below say the same, with a remedy.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.setLogLevel(_ERRORS)
    # A playlist would open what it names, files and addresses.
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = f"protocol_whitelist;file|format_whitelist;{_CONTAINERS}"
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        if video.suffix.lower() in _PICTURES:
            raise InputError(f"{video} is a picture: give a video, or the folder of the pictures")
        raise InputError(
            f"{video} is no video that can be read: copy it again where it may be cut off, or convert it to H.264 in "
            "an .mp4 file"
        )
    return capture


def _fit(capture: Any, calibrated: Camera, video: Path, camera_yaml: Path) -> tuple[Camera, list[str]]:
    """The camera of the frames, and whether they are taken as the sensor saw them or upright as players show them.

    A phone writes the sensor's frames and a rotation. A calibration of upright frames has their size, any other that
    of the sensor.
    """
    width, height = (int(_property(capture, key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    try:
        check_size(width, height)
    except InputError as error:
        raise InputError(f"{video}: {error}: convert it, or film at another size") from None
    turned = int(_property(capture, cv2.CAP_PROP_ORIENTATION_META)) % 180 != 0
    upright = bool(capture.get(cv2.CAP_PROP_ORIENTATION_AUTO))
    # OpenCV gives the size of the frames that it will return, which are upright if `upright`.
    sensor = (height, width) if turned and upright else (width, height)
    sizes = {False: sensor, True: sensor[::-1] if turned else sensor}
    for is_upright, size in sizes.items():
        if size == (calibrated.width, calibrated.height):
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, float(is_upright))
            return calibrated, []
    for is_upright, size in sizes.items():
        factor = size[0] / calibrated.width
        if abs(factor * calibrated.height - size[1]) <= 1.0:
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, float(is_upright))
            note = (
                f"{camera_yaml} is of {calibrated.width} x {calibrated.height}, the video of {size[0]} x {size[1]}: "
                "scaled, which holds only where both modes use the whole width of the sensor"
            )
            return calibrated.scaled(factor), [note]
    raise InputError(
        f"{video} is {sensor[0]} x {sensor[1]}, but {camera_yaml} was calibrated at "
        f"{calibrated.width} x {calibrated.height}, which has another aspect: calibrate in the video's own mode"
    )


def _property(capture: Any, key: int) -> float:
    """A number of the container, 0 where it has none."""
    value = capture.get(key)
    return value if np.isfinite(value) else 0.0
