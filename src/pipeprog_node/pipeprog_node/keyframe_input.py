# SPDX-License-Identifier: Apache-2.0
"""Keyframes as the nodes behind the selector receive them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

from sensor_msgs.msg import CameraInfo, CompressedImage

from pipeprog_camera.camera import Camera
from pipeprog_camera.limits import MAX_CAMERAS, MAX_ENCODED_IMAGE, MAX_UNPAIRED
from pipeprog_node import messages, qos
from pipeprog_node.intake import Intake, InvalidMessageError
from pipeprog_node.received import images as received_images
from pipeprog_node.received.images import ReceivedCamera, ReceivedImage

IMAGES, CALIBRATIONS = "keyframes/image/compressed", "keyframes/camera_info"
# The camera as the survey's images tell it, where it differs from the calibration: with the stamp of a map.
REFINED_CALIBRATION = "keyframes/refined_camera_info"
DEPTH = 50  # of both topics: keyframes that come while the node is busy

_Key = tuple[int, str]  # stamp [ns] and frame of a camera


class KeyframeInput:
    """Subscribes to keyframes: an image and its calibration are handed on once both have come.

    Cameras of one body may be triggered together: a nanosecond tells their images apart.

    Args:
        intake: the door of the node.
        use: gets stamp [ns], encoded image, camera and frame of each keyframe.
        lose: gets the stamp of one that will not come, as a part of it was dropped; for nodes that wait for it.
        known: where a journal is kept: stamps of the keyframes in it, which may come again and are passed over; what
            was published while nobody was there is asked for, too.
    """

    def __init__(
        self,
        intake: Intake,
        use: Callable[[int, bytes, Camera, str], None],
        lose: Callable[[int], None] = lambda stamp: None,
        known: Collection[int] | None = None,
    ) -> None:
        self._intake, self._use, self._lose = intake, use, lose
        self._known = frozenset(known or ())
        self._comes_again = known is not None
        self._images: dict[_Key, bytes] = {}  # without calibration
        self._cameras: dict[_Key, Camera] = {}  # without image
        self._stamps: dict[_Key, int] = {}  # of the keyframes handed on: theirs alone
        self._keys: dict[int, _Key] = {}  # the reverse
        self._earliest: int | None = None  # stamp of anything that has come
        depth = qos.reliable(DEPTH) if known is None else qos.kept(DEPTH)
        intake.subscribe(
            CompressedImage, IMAGES, received_images.compressed_image, self._on_image, depth, dropped=self._on_dropped
        )
        intake.subscribe(
            CameraInfo, CALIBRATIONS, received_images.camera_info, self._on_camera, depth, dropped=self._on_dropped
        )

    def forget(self, stamps: Iterable[int]) -> None:
        """Keyframes of these stamps may come again."""
        for stamp in stamps:
            if stamp in self._keys:
                del self._stamps[self._keys.pop(stamp)]

    def missed(self, stamp: int) -> bool:
        """Whether a keyframe was published before this node was there: topics keep their order, and later ones came."""
        return self._earliest is not None and stamp < self._earliest

    def _on_image(self, image: ReceivedImage) -> None:
        key = image.stamp, image.frame_id
        if self._is_new(key, IMAGES):
            self._images[key] = image.encoded
            self._pair(key)
            while len(self._images) > 1 and (
                len(self._images) > MAX_UNPAIRED or sum(map(len, self._images.values())) > MAX_ENCODED_IMAGE
            ):
                self._drop_oldest(self._images, IMAGES, "calibration")

    def _on_camera(self, calibration: ReceivedCamera) -> None:
        key = calibration.stamp, calibration.frame_id
        if self._is_new(key, CALIBRATIONS):
            self._cameras[key] = calibration.camera
            self._pair(key)
            if len(self._cameras) > MAX_UNPAIRED:
                self._drop_oldest(self._cameras, CALIBRATIONS, "image")

    def _on_dropped(self, message: CompressedImage | CameraInfo) -> None:
        self._lose(messages.stamp_ns(message.header.stamp))

    def _is_new(self, key: _Key, topic: str) -> bool:
        self._earliest = key[0] if self._earliest is None else min(key[0], self._earliest)
        if key[0] in self._known or (self._comes_again and key in self._stamps):
            return False
        if key in self._stamps:
            text = f"the keyframe of camera {key[1]!r} at {key[0]} ns came twice: is it published by two nodes?"
            self._intake.reject(topic, InvalidMessageError("repeated", text))
            return False
        return True

    def _drop_oldest(self, unpaired: dict[_Key, Any], topic: str, missing: str) -> None:
        key = next(iter(unpaired))
        del unpaired[key]
        text = f"no {missing} of camera {key[1]!r} at {key[0]} ns has come: publish both with one stamp and frame_id"
        self._intake.reject(topic, InvalidMessageError("unpaired", text))
        self._lose(key[0])

    def _pair(self, key: _Key) -> None:
        if key not in self._images or key not in self._cameras:
            return
        image, camera = self._images.pop(key), self._cameras.pop(key)
        stamp = next((stamp for stamp in range(key[0], key[0] + MAX_CAMERAS) if stamp not in self._keys), None)
        if stamp is None:
            text = f"{MAX_CAMERAS} keyframes at {key[0]} ns have come already: camera {key[1]!r} is left out"
            self._intake.reject(IMAGES, InvalidMessageError("cameras", text))
            return
        self._stamps[key], self._keys[stamp] = stamp, key
        self._use(stamp, image, camera, key[1])
