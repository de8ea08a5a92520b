# SPDX-License-Identifier: Apache-2.0
"""Whether a frame of a recording can be used: its message, its picture and the calibration in force.

The nodes ask the same of what they receive. A frame that they would drop must not be sent to them: a replay waits for
an answer to each.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

from pipeprog_bringup.recording import cdr
from pipeprog_camera.encoded_image import check_bytes, check_size, encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CHANNELS
from pipeprog_camera.raw_image import check_layout


@dataclass(frozen=True)
class Calibration:
    """A CameraInfo as recorded: its bytes, the size [px] that it is for, and why it cannot be used (empty: it can)."""

    data: bytes
    frame_id: str
    width: int
    height: int
    fault: str

    @classmethod
    def read(cls, data: bytes) -> Calibration:
        """From CDR bytes; ValueError where they are damaged."""
        info = cdr.read_camera_info(data)
        return cls(data, info.frame_id, info.width, info.height, _fault_of_camera(info))


@dataclass(frozen=True)
class ImageMessage:
    """One image of a recording: header stamp [ns], frame, serialised message, and the calibration in force.

    `fault` says why it cannot be used, beginning with one of frame_log.FAULTS; it is empty where it can. The stamp of a
    message that is damaged is the time at which it was recorded.
    """

    stamp: int
    frame_id: str
    data: bytes
    camera_info: bytes
    fault: str = ""


@functools.lru_cache(maxsize=16)
def _fault_of_camera(info: cdr.CameraInfo) -> str:
    try:
        info.camera()
    except InputError as error:
        return f"calibration cannot be used: {error}"
    return ""


class FrameCheck:
    """Checks the images of a topic, in the order of the recording, against the CameraInfo messages before each.

    `first` serves images before any. `damaged` counts the CameraInfo messages that could not be read.
    """

    def __init__(self, image_type: str, info_topic: str, first: Calibration) -> None:
        self._image_type, self._info_topic = image_type, info_topic
        self._newest = first
        self._latest: dict[str, Calibration] = {}  # by the camera's frame
        self.damaged = 0

    def calibrate(self, data: bytes) -> None:
        """A CameraInfo came."""
        try:
            self._newest = Calibration.read(data)
        except ValueError:
            self.damaged += 1
            return
        frame_id = self._newest.frame_id
        if frame_id in self._latest or len(self._latest) < MAX_CHANNELS:
            self._latest[frame_id] = self._newest

    def image(self, data: bytes, log_time: int) -> ImageMessage:
        """The image in a serialised message, with what is wrong with it."""
        try:
            image = cdr.read_image(data, self._image_type)
        except cdr.StampError as error:
            return ImageMessage(log_time, "", data, self._newest.data, str(error))
        except ValueError:
            return ImageMessage(log_time, "", data, self._newest.data, "damaged message")
        calibration = self._latest.get(image.frame_id, self._newest)
        return ImageMessage(image.stamp, image.frame_id, data, calibration.data, self._fault(image, calibration))

    def left_out(self, stamp: int, frame_id: str, fault: str) -> ImageMessage:
        """An image that is not there, for the reason `fault`."""
        return ImageMessage(stamp, frame_id, b"", self._newest.data, fault)

    def _fault(self, image: cdr.ImageFields, calibration: Calibration) -> str:
        try:
            width, height = image_size(image, self._image_type)
        except InputError as error:
            return f"damaged image: {error}"
        if calibration.fault:
            return calibration.fault
        if (width, height) == (calibration.width, calibration.height):
            return ""
        return (
            f"size does not fit: the image is {width} x {height}, but {self._info_topic} is calibrated for "
            f"{calibration.width} x {calibration.height}: record the CameraInfo of this camera mode"
        )


def image_size(image: cdr.ImageFields, type_name: str) -> tuple[int, int]:
    """(width, height) [px] that the image declares; raises InputError where it is none that can be used."""
    if type_name == cdr.COMPRESSED_IMAGE:
        return encoded_size(bytes(image.data))
    check_bytes(len(image.data))
    check_size(image.width, image.height)
    check_layout(image.width, image.height, image.encoding, image.step, len(image.data))
    return image.width, image.height
