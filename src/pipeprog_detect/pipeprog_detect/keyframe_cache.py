# SPDX-License-Identifier: Apache-2.0
"""The keyframes of a survey as the detector wants them: grey and colour, undistorted, decoded once as memory allows."""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_detect.silhouette.chromaticity import red_against_blue
from pipeprog_detect.types import View

# Decoded images kept [bytes], each with its colour: 290 of 720p, 32 of 4K.
_MOST_BYTES = 512 * 2**20


class Keyframes:
    """Encoded keyframes by stamp, and the decoded ones that fit in memory."""

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._encoded: dict[int, tuple[bytes, Camera]] = {}
        self._images: OrderedDict[int, tuple[NDArray[np.uint8], NDArray[np.uint8] | None]] = OrderedDict()
        self._most_bytes = most_bytes

    def __contains__(self, stamp: int) -> bool:
        """Whether a keyframe of this stamp was added."""
        return stamp in self._encoded

    def add(self, stamp: int, encoded: bytes, camera: Camera) -> None:
        """Takes a keyframe (JPEG or PNG bytes, stamp in ns)."""
        self._encoded[stamp] = (encoded, camera)
        self._images.pop(stamp, None)

    def replace_camera(self, camera: Camera) -> bool:
        """Gives all keyframes this calibration; whether one had another."""
        others = [stamp for stamp, (_, own) in self._encoded.items() if own != camera]
        for stamp in others:
            self.add(stamp, self._encoded[stamp][0], camera)
        return bool(others)

    def remove(self, stamp: int) -> None:
        """Forgets a keyframe; one that is not known is ignored."""
        self._encoded.pop(stamp, None)
        self._images.pop(stamp, None)

    def is_decoded(self, stamp: int) -> bool:
        """Whether `view` has the image at hand."""
        return stamp in self._images

    def camera(self, stamp: int) -> Camera:
        """The calibration of a keyframe."""
        return self._encoded[stamp][1]

    def colour(self, stamp: int) -> NDArray[np.uint8]:
        """The keyframe (H, W, 3) in blue, green and red, undistorted; raises InputError where it cannot be decoded."""
        return _decoded(stamp, *self._encoded[stamp], cv2.IMREAD_COLOR)

    def view(self, stamp: int, map_from_camera: FloatArray) -> View:
        """The keyframe at its pose (4, 4); raises InputError where it cannot be decoded."""
        encoded, camera = self._encoded[stamp]
        images = self._images.pop(stamp, None)
        if images is None:
            images = _decoded(stamp, encoded, camera), red_against_blue(self.colour(stamp))
        self._images[stamp] = images
        held = sum(_bytes(*other) for other in self._images.values())
        while held > self._most_bytes and len(self._images) > 1:
            held -= _bytes(*self._images.popitem(last=False)[1])
        image, chromaticity = images
        camera_from_map = np.linalg.inv(map_from_camera).astype(float)
        return View(stamp, image, camera.pinhole(), camera_from_map, chromaticity=chromaticity)


def _bytes(image: NDArray[np.uint8], chromaticity: NDArray[np.uint8] | None) -> int:
    return image.nbytes + (0 if chromaticity is None else chromaticity.nbytes)


def _decoded(stamp: int, encoded: bytes, camera: Camera, mode: int = cv2.IMREAD_GRAYSCALE) -> NDArray[np.uint8]:
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), mode)
    except cv2.error:  # some damaged headers; for other damage it returns None
        image = None
    if image is None:
        raise InputError(f"the keyframe at {stamp} ns cannot be decoded")
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"the keyframe at {stamp} ns has {image.shape[1]} x {image.shape[0]} pixels, its CameraInfo says "
            f"{camera.width} x {camera.height}: calibrate at the size that the camera sends"
        )
    return camera.undistort_image(np.asarray(image, np.uint8))
