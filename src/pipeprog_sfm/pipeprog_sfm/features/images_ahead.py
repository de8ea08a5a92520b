# SPDX-License-Identifier: Apache-2.0
"""Images of keyframes that wait for their turn: decoded, and their features extracted, beside the one worked off."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.sift import Features, extract


@dataclass(frozen=True)
class PreparedImage:
    """A decoded image (H, W) uint8, and its features where they are there already."""

    gray: NDArray[np.uint8]
    features: Features | None = None


@dataclass(frozen=True)
class _Expected:
    encoded: bytes
    camera: Camera
    prepared: Future[PreparedImage]


class ImagesAhead:
    """Prepares images in a thread of its own, in the order in which they are expected.

    A third of what a keyframe costs is its features, which need nothing of the map. What is prepared is the same as
    without: no result depends on whether an image was expected in time.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._expected: dict[int, _Expected] = {}
        self._thread = ThreadPoolExecutor(max_workers=1)

    def expect(self, stamp: int, encoded: bytes, camera: Camera) -> None:
        """Starts to prepare a keyframe's image; from any thread. Problems are told when it is taken."""
        self._expected[stamp] = _Expected(encoded, camera, self._thread.submit(self._prepare, encoded, camera))

    def take(self, stamp: int, encoded: bytes, told: Camera, used: Camera) -> PreparedImage:
        """The image of a keyframe, without features where they are not there for the calibration used.

        Args:
            stamp: of the keyframe [ns].
            encoded: JPEG or PNG bytes.
            told: the calibration that came with it.
            used: that with which it is to be used.

        Raises:
            InputError: the image cannot be used.
        """
        expected = self._expected.pop(stamp, None)
        if expected is None or expected.encoded is not encoded or expected.prepared.cancel():
            return PreparedImage(decoded(encoded, told))
        prepared = expected.prepared.result()
        return prepared if expected.camera == used else PreparedImage(prepared.gray)

    def forget(self, stamp: int) -> None:
        """Gives up a keyframe that will not be taken."""
        expected = self._expected.pop(stamp, None)
        if expected is not None:
            expected.prepared.cancel()

    def _prepare(self, encoded: bytes, camera: Camera) -> PreparedImage:
        gray = decoded(encoded, camera)
        return PreparedImage(gray, extract(gray, camera, self._config))


def decoded(encoded: bytes, camera: Camera) -> NDArray[np.uint8]:
    """(H, W) uint8 pixels of JPEG or PNG bytes; InputError where they are damaged or not of the camera's size."""
    encoded_size(encoded)  # before it is decoded
    gray = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise InputError("the image is damaged: it is left out")
    if gray.shape != (camera.height, camera.width):
        raise InputError(
            f"the image has {gray.shape[1]} x {gray.shape[0]} pixels, its CameraInfo says "
            f"{camera.width} x {camera.height}: calibrate at the size that the camera sends"
        )
    return np.asarray(gray, np.uint8)
