"""The process that detects: seconds of computing that the node's callbacks must not wait for."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.connection import Connection

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_detect.bill import Bill
from pipeprog_detect.classify import ClassProgress, progress
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.pipe import Cloud, Pipe, View


@dataclass(frozen=True)
class Keyframe:
    """Command: keep this keyframe for the outlines; `encoded` holds JPEG or PNG bytes."""

    stamp: int
    encoded: bytes
    camera: Camera


@dataclass(frozen=True)
class Map:
    """Command: detect in this map; poses (M, 4, 4) map_from_camera belong to stamps (M,)."""

    revision: int
    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    stamps: NDArray[np.int64]
    map_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class PipesReady:
    """Event: the pipes of a map."""

    revision: int
    pipes: list[Pipe]
    progress: list[ClassProgress]


def serve(connection: Connection, config: DetectConfig, bill: Bill) -> None:
    """Works off commands from `connection` until it closes; of the maps that wait, only the newest counts."""
    keyframes: dict[int, Keyframe] = {}
    while True:
        newest: Map | None = None
        while newest is None or connection.poll():
            command = connection.recv()
            if isinstance(command, Keyframe):
                keyframes[command.stamp] = command
            else:
                newest = command
        cloud = Cloud(newest.points.astype(float), None if newest.normals is None else newest.normals.astype(float))
        views = [
            _view(keyframes[stamp], pose)
            for stamp, pose in zip(newest.stamps.tolist(), newest.map_from_camera, strict=True)
            if stamp in keyframes
        ]
        pipes = detect(cloud, bill, config, views)
        connection.send(PipesReady(newest.revision, pipes, progress(pipes, bill)))


def _view(keyframe: Keyframe, map_from_camera: NDArray[np.float64]) -> View:
    image = cv2.imdecode(np.frombuffer(keyframe.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise RuntimeError(f"keyframe {keyframe.stamp} has a pose but cannot be decoded")
    camera_from_map = np.linalg.inv(map_from_camera).astype(float)
    return View(keyframe.stamp, keyframe.camera.undistort_image(image), keyframe.camera.pinhole(), camera_from_map)
