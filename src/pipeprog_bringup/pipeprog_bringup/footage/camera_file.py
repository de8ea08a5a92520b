# SPDX-License-Identifier: Apache-2.0
"""A camera's calibration in the YAML format of ROS's camera_calibration, with the read-out of its shutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.file_kinds import kind_of
from pipeprog_camera.files.yaml_file import line_of, read_yaml
from pipeprog_camera.outside_text import name_of, shown
from pipeprog_camera.rolling_shutter import check_readout


@dataclass(frozen=True)
class CameraFile:
    """What a calibration file holds: the camera, and its read-out [s] from first row to last, None where not told."""

    camera: Camera
    readout: float | None


def read_camera_file(path: Path) -> CameraFile:
    """Camera and read-out of a calibration; raises InputError where it is none."""
    content = read_yaml(path)
    try:
        if not isinstance(content, dict):
            raise InputError("it is no mapping")
        if "camera_matrix" not in content and (kind := kind_of(content)):
            raise InputError(kind)
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
        readout = None if content.get("readout") is None else _number(content, "readout", content["readout"])
        if readout is not None:
            check_readout(readout)
        return CameraFile(Camera.from_calibration(width, height, matrix, model, distortion), readout)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def camera_file_text(camera: Camera, readout: float | None, comments: Sequence[str]) -> str:
    """What `read_camera_file` reads, with lines for people at its beginning."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    lines = [f"# {comment}" for comment in comments]
    lines += [f"image_width: {camera.width}", f"image_height: {camera.height}", "camera_name: camera"]
    lines += _matrix("camera_matrix", 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    lines += [f"distortion_model: {camera.distortion_model}"]
    lines += _matrix("distortion_coefficients", 1, camera.distortion)
    lines += _matrix("rectification_matrix", 3, np.eye(3).ravel().tolist())
    lines += _matrix("projection_matrix", 3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    lines += [] if readout is None else [f"readout: {readout!r}  # s, from the first row of an image to the last"]
    return "\n".join(lines) + "\n"


def _matrix(name: str, rows: int, data: Sequence[float]) -> list[str]:
    numbers = ", ".join(repr(float(value)) for value in data)
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(data) // rows}", f"  data: [{numbers}]"]


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
