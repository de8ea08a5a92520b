# SPDX-License-Identifier: Apache-2.0
"""The keyframes that a run has kept, with their cameras and poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.results_reader import Results
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError


@dataclass(frozen=True)
class Keyframe:
    """A registered keyframe: its number from 1 (the line of trajectory.tum), stamp [ns], camera, map_from_camera."""

    number: int
    stamp: int
    camera: Camera
    pose: FloatArray
    encoded: bytes

    @property
    def image(self) -> NDArray[np.uint8]:
        """(H, W, 3) BGR as the camera saw it; raises InputError where it is damaged."""
        image = cv2.imdecode(np.frombuffer(self.encoded, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise InputError(f"keyframe {self.number} is damaged: run `pipeprog replay` again")
        return np.asarray(image, np.uint8)


def keyframes(results: Results) -> Iterator[Keyframe]:
    """The keyframes of out.mcap that have a pose; raises InputError where the run has kept none."""
    path = results.folder / "out.mcap"
    if not path.is_file() or not len(results.stamps):
        raise InputError(
            f"{results.folder} has kept no keyframes (out.mcap, trajectory.tum): export a replay's results"
        )
    number_of = {int(stamp): number for number, stamp in enumerate(results.stamps)}
    for frame in Bag.open(path):
        if frame.fault or frame.stamp not in number_of:
            continue
        number = number_of[frame.stamp]
        camera = cdr.read_camera_info(frame.camera_info).camera()
        encoded = bytes(cdr.read_image(frame.data, cdr.COMPRESSED_IMAGE).data)
        yield Keyframe(number + 1, frame.stamp, camera, results.map_from_camera[number], encoded)
