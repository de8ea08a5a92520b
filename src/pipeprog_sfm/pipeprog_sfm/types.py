# SPDX-License-Identifier: Apache-2.0
"""Types that several stages share."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera


@dataclass(frozen=True)
class EncodedImage:
    """A keyframe as it was received: JPEG or PNG bytes, and its calibration."""

    data: bytes
    camera: Camera

    def gray(self) -> NDArray[np.uint8]:
        """(H, W) pixels as the camera saw them; it could be decoded when it was added."""
        gray = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        return np.asarray(gray, np.uint8)
