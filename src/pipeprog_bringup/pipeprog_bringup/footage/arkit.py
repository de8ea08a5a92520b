# SPDX-License-Identifier: Apache-2.0
"""Numbers of ARKit, which scanning apps write down: poses into ROS's axes, cameras, depth images.

ARKit's world has y up; its camera has y up and looks along -z. ROS (REP-103, REP-105): world z up, optical frame of a
camera x right, y down, z ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_COORDINATE, MAX_QUATERNION_ERROR

WORLD_FROM_ARKIT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y up -> z up
ARKIT_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])


def pose_of_rows(rows: FloatArray) -> FloatArray:
    """(4, 4) of the (3, 4) upper rows of a pose; raises InputError where they are no rigid motion."""
    pose = np.eye(4)
    pose[:3] = rows
    turn = pose[:3, :3]
    rigid = np.allclose(turn @ turn.T, np.eye(3), atol=2 * MAX_QUATERNION_ERROR) and np.linalg.det(turn) > 0
    if not np.isfinite(pose).all() or not rigid or np.abs(pose[:3, 3]).max() > MAX_COORDINATE:
        raise InputError("a pose is no rotation and translation: export the scan again")
    return pose


def pose_of_quaternion(position: Sequence[float], quaternion: Sequence[float]) -> FloatArray:
    """(4, 4) of x, y, z [m] and x, y, z, w; raises InputError where they are no pose."""
    if not np.isfinite(quaternion).all() or abs(np.linalg.norm(quaternion) - 1.0) > MAX_QUATERNION_ERROR:
        raise InputError("a pose's quaternion has not the length one: export the scan again")
    return pose_of_rows(np.c_[Rotation.from_quat(quaternion).as_matrix(), position])


def pinhole(size: tuple[int, int], fx: Any, fy: Any, cx: Any, cy: Any) -> Camera:
    """The camera of pictures of (width, height) px; raises InputError where the numbers are none of one."""
    try:
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    except (TypeError, ValueError):
        raise InputError("its intrinsics are no numbers: export the scan again") from None
    return Camera.from_calibration(*size, k)


def depth_image(data: bytes) -> NDArray[np.uint16] | None:
    """(H, W) depths [mm] of a PNG of 16 bits; None where it is none."""
    image = _decoded(data)
    return image if image is not None and image.dtype == np.uint16 else None


def confidence_image(data: bytes, highest: int) -> NDArray[np.uint8] | None:
    """(H, W) 0 (low), 1, 2 (high) of a PNG whose highest value is `highest`; None where it is none."""
    image = _decoded(data)
    if image is None or image.dtype != np.uint8:
        return None
    return np.rint(2.0 * image.clip(max=highest) / highest).astype(np.uint8)


def _decoded(data: bytes) -> NDArray[Any] | None:
    """The grey image in a PNG."""
    try:
        encoded_size(data)
    except InputError:
        return None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image if image is not None and image.ndim == 2 else None
