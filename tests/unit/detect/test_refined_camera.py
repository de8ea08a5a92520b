# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a survey that has refined the camera are measured with that camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_detect.keyframe_cache import Keyframes

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
REFINED = replace(CAMERA, fx=50.5, fy=50.5, distortion=(0.1, 0.0, 0.0, 0.0))


def test_keyframes_are_undistorted_with_the_refined_camera() -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
    keyframes = Keyframes()
    keyframes.add(1, cv2.imencode(".png", image)[1].tobytes(), CAMERA)
    assert np.array_equal(keyframes.view(1, np.eye(4)).image, image)
    assert keyframes.replace_camera(REFINED)
    assert not keyframes.replace_camera(REFINED)
    view = keyframes.view(1, np.eye(4))
    assert view.camera == REFINED.pinhole()
    assert np.array_equal(view.image, REFINED.undistort_image(image))
