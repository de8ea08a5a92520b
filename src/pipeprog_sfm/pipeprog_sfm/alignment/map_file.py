# SPDX-License-Identifier: Apache-2.0
"""map.npz written and read; docs/files.md describes its arrays. What a file declares is compared before it is read."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import (
    MAX_BOARD_CIRCLES,
    MAX_CIRCLES,
    MAX_COORDINATE,
    MAX_DISTORTION_COEFFICIENTS,
    MAX_MAP_ARRAY,
    MAX_MAP_CLOUD,
    MAX_MAP_FEATURES,
    MAX_NAME,
    MAX_PIPE_RADIUS,
    MAX_PIPES,
    MAX_POSES,
    MAX_QUATERNION_ERROR,
)
from pipeprog_camera.outside_text import name_of, shown
from pipeprog_sfm.alignment.survey_map import MappedBoard, MappedPipe, SurveyMap

MAP_FILE = "map.npz"  # in a folder of results
VERSION = 1
PIXEL_STEP = 1 / 16  # px of `pixels`: its rounding (0.02 px) is far below the noise of features (0.3 px)
CLOUD_STEP = 0.001  # m of `cloud`, a quarter of its noise
NORMAL_STEP = 1 / 127  # of `normals`
ALIGNED_BY = ("", "boards", "places")


def write_map(path: Path, survey: SurveyMap) -> None:
    """Writes a survey's map; the same map gives the same bytes."""
    cameras = list(dict.fromkeys(survey.cameras))
    low = survey.cloud.min(axis=0).astype(float) if len(survey.cloud) else np.zeros(3)
    circles = [board.circles for board in survey.boards]
    arrays = {
        "version": np.array(VERSION, np.int32),
        "frame": _texts([survey.frame, survey.aligned_by]),
        "scale_sigma": np.array(survey.scale_sigma),
        "alignment": survey.alignment_covariance.astype(np.float64),
        "stamps": survey.stamps.astype(np.int64),
        "poses": survey.map_from_camera[:, :3].astype(np.float64),
        "camera_of": np.array([cameras.index(camera) for camera in survey.cameras], np.int32),
        "cameras": np.array([_camera_row(camera) for camera in cameras]).reshape(-1, _CAMERA_COLUMNS),
        "camera_models": _texts([camera.distortion_model for camera in cameras]),
        "features": np.diff(survey.offsets).astype(np.int32),
        "pixels": np.rint(survey.pixels / PIXEL_STEP).astype(np.int32),
        "descriptors": survey.descriptors,
        "point_of": survey.point_of.astype(np.int32),
        "points": survey.points.astype(np.float32),
        "boards": _texts([board.name for board in survey.boards]),
        "board_circles": np.array([len(one) for one in circles], np.int32),
        "circles": np.concatenate([*circles, np.empty((0, 3))]),
        "cloud_origin": low,
        "cloud": np.rint((survey.cloud - low) / CLOUD_STEP).astype(np.int32),
        "normals": np.rint(survey.normals / NORMAL_STEP).astype(np.int8),
        "pipes": np.array([[*pipe.ends.ravel(), pipe.radius, pipe.length_sigma] for pipe in survey.pipes]).reshape(
            -1, 8
        ),
        "pipe_names": _texts([text for pipe in survey.pipes for text in (pipe.life, pipe.class_name)]),
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.array(array, order="C"), allow_pickle=False)
            # A fixed date, or two writings of one map would differ.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), content.getvalue(), 8)


def read_map(path: Path) -> SurveyMap:
    """The map in a file; raises InputError, naming the file and the array, where it is none."""
    if not path.is_file():
        raise InputError(f"{path}: no such file: give the results folder of a replay or survey that has a map.npz")
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {name: _read_array(archive, name, kind) for name, kind in _ARRAYS.items()}
            return _survey(arrays)
    except InputError as error:
        raise InputError(f"{path} is no map of pipeprog ({error}): make the survey again") from None
    except (OSError, EOFError, ValueError, KeyError, NotImplementedError, RuntimeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no map of pipeprog ({shown(str(error))}): make the survey again") from None
    except zipfile.zlib.error as error:  # type: ignore[attr-defined]  # what a damaged member raises
        raise InputError(f"{path} is damaged ({error}): make the survey again") from None


@dataclass(frozen=True)
class _Kind:
    """How an array must be: its type, its shape (None: any length of the first axis), and the largest value."""

    dtype: str
    shape: tuple[int | None, ...]
    rows: int = 1
    largest: float | None = None


_CAMERA_COLUMNS = 6 + 1 + MAX_DISTORTION_COEFFICIENTS
_ARRAYS = {
    "version": _Kind("int32", ()),
    "frame": _Kind("U", (None,), 2),
    "scale_sigma": _Kind("float64", ()),
    "alignment": _Kind("float64", (7, 7), 7, 1e6),
    "stamps": _Kind("int64", (None,), MAX_POSES),
    "poses": _Kind("float64", (None, 3, 4), MAX_POSES, MAX_COORDINATE),
    "camera_of": _Kind("int32", (None,), MAX_POSES),
    "cameras": _Kind("float64", (None, _CAMERA_COLUMNS), MAX_POSES, 1e9),
    "camera_models": _Kind("U", (None,), MAX_POSES),
    "features": _Kind("int32", (None,), MAX_POSES),
    "pixels": _Kind("int32", (None, 2), MAX_MAP_FEATURES),
    "descriptors": _Kind("uint8", (None, 128), MAX_MAP_FEATURES),
    "point_of": _Kind("int32", (None,), MAX_MAP_FEATURES),
    "points": _Kind("float32", (None, 3), MAX_MAP_FEATURES, MAX_COORDINATE),
    "boards": _Kind("U", (None,), MAX_CIRCLES),
    "board_circles": _Kind("int32", (None,), MAX_CIRCLES),
    "circles": _Kind("float64", (None, 3), MAX_CIRCLES, MAX_COORDINATE),
    "cloud_origin": _Kind("float64", (3,), 3, MAX_COORDINATE),
    "cloud": _Kind("int32", (None, 3), MAX_MAP_CLOUD),
    "normals": _Kind("int8", (None, 3), MAX_MAP_CLOUD),
    "pipes": _Kind("float64", (None, 8), MAX_PIPES),
    "pipe_names": _Kind("U", (None,), 2 * MAX_PIPES),
}


def _read_array(archive: zipfile.ZipFile, name: str, kind: _Kind) -> NDArray[Any]:
    """An array whose header says what it must before its values are inflated; raises InputError where it does not."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise InputError(f"it holds no array '{name}'") from None
    if info.file_size > MAX_MAP_ARRAY:
        raise InputError(f"array '{name}' has {info.file_size} bytes, more than {MAX_MAP_ARRAY}")
    with archive.open(info) as stream:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise InputError(f"array '{name}' is of another version of NumPy's format")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        of_type = dtype.kind == "U" and dtype.itemsize <= 4 * MAX_NAME if kind.dtype == "U" else dtype == kind.dtype
        fits = len(shape) == len(kind.shape) and all(b in (None, a) for a, b in zip(shape, kind.shape, strict=True))
        if fortran or not of_type or not fits or (shape and shape[0] > kind.rows):
            raise InputError(f"array '{name}' is of type {shown(str(dtype))} and shape {shown(str(shape))}")
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        data = stream.read(size + 1)
    if len(data) != size:
        raise InputError(f"array '{name}' ends before its last value")
    array = np.frombuffer(data, dtype).reshape(shape).copy()
    if kind.largest is not None and not (np.abs(array) <= kind.largest).all():
        raise InputError(f"array '{name}' holds values that are not finite, or beyond {kind.largest:g}")
    return array


def _survey(arrays: dict[str, NDArray[Any]]) -> SurveyMap:
    """The map of arrays that are each as they must be; raises InputError where they do not fit each other."""
    if int(arrays["version"]) != VERSION:
        raise InputError(f"its version is {int(arrays['version'])}, and this pipeprog reads {VERSION}")
    views, features, points = len(arrays["stamps"]), len(arrays["pixels"]), len(arrays["points"])
    _check("poses", len(arrays["poses"]) == len(arrays["camera_of"]) == len(arrays["features"]) == views > 0)
    _check("stamps", len(np.unique(arrays["stamps"])) == views)
    _check("features", (arrays["features"] >= 0).all() and int(arrays["features"].sum(dtype=np.int64)) == features)
    _check("descriptors", len(arrays["descriptors"]) == len(arrays["point_of"]) == features)
    _check("point_of", _indices(arrays["point_of"], points))
    _check("camera_of", _indices(arrays["camera_of"], len(arrays["cameras"])))
    _check("camera_models", len(arrays["camera_models"]) == len(arrays["cameras"]))
    _check("normals", len(arrays["normals"]) == len(arrays["cloud"]))
    _check("scale_sigma", 0.0 <= float(arrays["scale_sigma"]) < 1.0)
    frame = [str(text) for text in arrays["frame"]]
    _check("frame", len(frame) == 2 and frame[0].isalnum() and frame[1] in ALIGNED_BY)
    rotation = arrays["poses"][:, :, :3]
    right = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(initial=0.0) < MAX_QUATERNION_ERROR
    _check("poses", right and (np.linalg.det(rotation) > 0).all())
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3] = arrays["poses"]
    rows = zip(arrays["cameras"], arrays["camera_models"], strict=True)
    cameras = [_camera(row, str(model)) for row, model in rows]
    return SurveyMap(
        frame=frame[0],
        aligned_by=frame[1],
        scale_sigma=float(arrays["scale_sigma"]),
        stamps=arrays["stamps"],
        cameras=tuple(cameras[index] for index in arrays["camera_of"].tolist()),
        map_from_camera=poses,
        offsets=np.concatenate([[0], np.cumsum(arrays["features"], dtype=np.int64)]),
        pixels=(arrays["pixels"] * PIXEL_STEP).astype(np.float32),
        descriptors=arrays["descriptors"],
        point_of=arrays["point_of"].astype(np.int64),
        points=arrays["points"].astype(np.float64),
        boards=_boards(arrays),
        cloud=(arrays["cloud_origin"] + arrays["cloud"] * CLOUD_STEP).astype(np.float32),
        normals=(arrays["normals"] * NORMAL_STEP).astype(np.float32),
        pipes=_pipes(arrays),
        alignment_covariance=arrays["alignment"],
    )


def _boards(arrays: dict[str, NDArray[Any]]) -> tuple[MappedBoard, ...]:
    counts = arrays["board_circles"]
    _check(
        "board_circles", len(counts) == len(arrays["boards"]) and ((counts > 0) & (counts <= MAX_BOARD_CIRCLES)).all()
    )
    _check("circles", int(counts.sum(dtype=np.int64)) == len(arrays["circles"]))
    parts = np.split(arrays["circles"], np.cumsum(counts)[:-1]) if len(counts) else []
    names = [name_of(str(name), "a board's name") for name in arrays["boards"]]
    return tuple(MappedBoard(name, part) for name, part in zip(names, parts, strict=True))


def _pipes(arrays: dict[str, NDArray[Any]]) -> tuple[MappedPipe, ...]:
    table, names = arrays["pipes"], [str(text) for text in arrays["pipe_names"]]
    _check("pipe_names", len(names) == 2 * len(table))
    _check("pipes", (np.abs(table[:, :6]) <= MAX_COORDINATE).all())
    _check("pipes", ((table[:, 6] > 0) & (table[:, 6] <= MAX_PIPE_RADIUS)).all())
    _check("pipes", (np.linalg.norm(table[:, 3:6] - table[:, :3], axis=1) > 0).all())
    lives = [name_of(text, "a pipe's id") for text in names[::2]]
    classes = [text and name_of(text, "a class") for text in names[1::2]]
    return tuple(
        MappedPipe(life, name, row[:6].reshape(2, 3), float(row[6]), float(row[7]))
        for life, name, row in zip(lives, classes, table, strict=True)
    )


def _camera_row(camera: Camera) -> list[float]:
    coefficients = [*camera.distortion, *[0.0] * MAX_DISTORTION_COEFFICIENTS][:MAX_DISTORTION_COEFFICIENTS]
    return [
        *(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        *(len(camera.distortion), *coefficients),
    ]


def _camera(row: NDArray[Any], model: str) -> Camera:
    """A camera of plausible numbers, as of a CameraInfo; raises InputError."""
    matrix = np.array([[row[2], 0.0, row[4]], [0.0, row[3], row[5]], [0.0, 0.0, 1.0]])
    count = int(row[6])
    _check("cameras", 0 <= count <= MAX_DISTORTION_COEFFICIENTS)
    return Camera.from_calibration(
        int(row[0]), int(row[1]), matrix.ravel().tolist(), model, row[7 : 7 + count].tolist()
    )


def _indices(array: NDArray[Any], count: int) -> bool:
    return bool(((array >= 0) & (array < count)).all())


def _texts(texts: Sequence[str]) -> NDArray[np.str_]:
    return np.array(texts, f"U{max(map(len, texts), default=1) or 1}")


def _check(name: str, is_right: Any) -> None:
    if not is_right:
        raise InputError(f"array '{name}' does not fit the others, or holds what cannot be")
