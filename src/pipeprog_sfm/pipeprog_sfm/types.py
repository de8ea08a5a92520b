# SPDX-License-Identifier: Apache-2.0
"""Types that several stages share."""

from __future__ import annotations

from dataclasses import dataclass

from pipeprog_camera.camera import Camera


@dataclass(frozen=True)
class EncodedImage:
    """A keyframe as it was received: JPEG or PNG bytes, and its calibration."""

    data: bytes
    camera: Camera
