# SPDX-License-Identifier: Apache-2.0
"""`pipeprog ingest`: a video and its camera's calibration become a recording."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import check_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_VIDEO_SECONDS
from pipeprog_camera.outside_text import name_of, shown
from pipeprog_camera.yaml_file import line_of, read_yaml

FRAME_ID = "camera_optical_frame"
_ERRORS = 2  # OpenCV's number for messages of errors alone
# Containers that cameras write; FFmpeg's names.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg,mxf,mjpeg,h264,hevc"
# Stamp of the first image [ns]: a video has no clock, and zero means "not set" in ROS.
START = 1_000_000_000


@dataclass(frozen=True)
class Ingested:
    """The result of `ingest`: frames written, seconds they span, and notes for the user."""

    frames: int
    seconds: float
    notes: list[str]


def ingest(
    video: Path, camera_yaml: Path, out: Path, quality: int, force: bool, report: Callable[[float, str], None]
) -> Ingested:
    """Write the frames of `video` as JPEG, with the calibration, into the recording `out`.

    Stamps are the video's own times, so a variable frame rate is kept. Raises InputError where video and calibration
    cannot be read or do not belong together.
    """
    calibrated = read_camera(camera_yaml)
    if out.suffix != ".mcap":
        raise InputError(f"--out {out}: a recording is an .mcap file")
    capture = _open(video)
    try:
        camera, notes = _fit(capture, calibrated, video, camera_yaml)
        expected = int(_property(capture, cv2.CAP_PROP_FRAME_COUNT))
        stamp, count = START, 0
        with output_file(out, force) as temporary, temporary.open("wb") as stream, BagWriter(stream) as writer:
            for stamp, image in _frames(capture):
                if (image.shape[1], image.shape[0]) != (camera.width, camera.height):
                    raise InputError(
                        f"{video}: frame {count + 1} is {image.shape[1]} x {image.shape[0]}, those before it "
                        f"{camera.width} x {camera.height}: cut the video there"
                    )
                encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
                info = cdr.write_camera_info(stamp, FRAME_ID, camera)
                writer.write("/camera/camera_info", cdr.CAMERA_INFO, info, stamp)
                data = cdr.write_compressed_image(stamp, FRAME_ID, "jpeg", encoded)
                writer.write("/camera/image/compressed", cdr.COMPRESSED_IMAGE, data, stamp)
                count += 1
                report(count / expected if expected > 0 else 0.0, f"{count} frames")
            if not count:
                raise InputError(f"{video} holds no frame that can be decoded: convert it to H.264 in an .mp4 file")
    finally:
        capture.release()
    # Containers overstate the number of frames by one or two; where more are missing, the video was cut off.
    if count < 0.98 * expected - 2:
        notes.append(f"{video} ends early: {count} of {expected} frames could be read")
    return Ingested(count, (stamp - START) * 1e-9, notes)


def read_camera(path: Path) -> Camera:
    """A calibration in the YAML format of ROS's camera_calibration; raises InputError where it is none."""
    content = read_yaml(path)
    try:
        if not isinstance(content, dict):
            raise InputError("it is no mapping")
        width, height = (int(_number(content, key, content.get(key))) for key in ("image_width", "image_height"))
        matrix, distortion = (_numbers(content, key) for key in ("camera_matrix", "distortion_coefficients"))
        if len(matrix) != 9:
            raise InputError(f"camera_matrix.data holds {len(matrix)} numbers, not 9")
        model = content.get("distortion_model", content.get("camera_model", "plumb_bob"))
        model = name_of(model, "distortion_model")
    except InputError as error:
        raise InputError(
            f"{path} is no camera calibration ({error}): it needs image_width, image_height, camera_matrix.data, "
            "distortion_model, distortion_coefficients.data"
        ) from None
    try:
        return Camera.from_calibration(width, height, matrix, model, distortion)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _numbers(content: dict[str, Any], key: str) -> list[float]:
    """The `data` of a matrix of a calibration."""
    data = content[key].get("data") if isinstance(content.get(key), dict) else None
    if not isinstance(data, list):
        raise InputError(f"{key}.data is missing")
    return [_number(content, f"{key}.data", value) for value in data]


def _number(content: dict[str, Any], key: str, value: Any) -> float:
    """A finite number of a calibration, which some tools quote."""
    if value is None:
        raise InputError(f"{key} is missing")
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{key}{line_of(content, key.partition('.')[0])} holds {shown(value)}, which is no number")
    return number


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
        raise InputError(f"{video} is no video that can be read: convert it to H.264 in an .mp4 file")
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


def _frames(capture: Any) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Stamps [ns] and images; where the container has no time of a day for a frame, its rate stands in."""
    rate = _property(capture, cv2.CAP_PROP_FPS)
    step = round(1e9 / rate) if 0.01 <= rate < 1000 else 33_333_333  # from time lapses to high speed
    last = START - step
    while True:
        ok, image = capture.read()
        if not ok:
            return
        seconds = 1e-3 * _property(capture, cv2.CAP_PROP_POS_MSEC)
        stamp = START + round(seconds * 1e9) if 0 <= seconds < MAX_VIDEO_SECONDS else last
        last = stamp if stamp > last else last + step
        yield last, image
