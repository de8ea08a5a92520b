# SPDX-License-Identifier: Apache-2.0
"""The process that detects: seconds of computing that the node's callbacks must not wait for."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_detect.cloud.map_change import MapChange
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.pipe_tracker import PipeTracker
from pipeprog_detect.product.product import Product, product_of
from pipeprog_detect.types import Cloud
from pipeprog_detect.verification.measurement_cache import MeasurementCache


@dataclass(frozen=True)
class Keyframe:
    """Command: keep this keyframe for the outlines; `encoded` holds JPEG or PNG bytes."""

    stamp: int
    encoded: bytes
    camera: Camera


@dataclass(frozen=True)
class Map:
    """Command: detect in this map; poses (M, 4, 4) map_from_camera belong to stamps (M,).

    What is found in a `final` map does not depend on the maps before it.
    """

    revision: int
    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    stamps: NDArray[np.int64]
    map_from_camera: NDArray[np.float64]
    final: bool


@dataclass(frozen=True)
class PipesReady:
    """Event: the product of a map."""

    revision: int
    product: Product


def serve(connection: Connection, config: DetectConfig, boq: BillOfQuantities) -> None:
    """Works off commands from `connection` until it closes; of the maps that wait, only the newest counts."""
    keyframes, identities, memory = Keyframes(), PipeTracker(), MeasurementCache()
    while True:
        newest: Map | None = None
        while newest is None or connection.poll():
            command = connection.recv()
            if isinstance(command, Keyframe):
                keyframes.add(command.stamp, command.encoded, command.camera)
            else:
                newest = command
        cloud = Cloud(newest.points.astype(float), None if newest.normals is None else newest.normals.astype(float))
        views = [
            keyframes.view(stamp, pose)
            for stamp, pose in zip(newest.stamps.tolist(), newest.map_from_camera, strict=True)
            if stamp in keyframes
        ]
        memory.next_map()
        if newest.final:
            memory.novelty = MapChange()
        pipes = identities.named(detect(cloud, boq, config, views, memory=memory))
        connection.send(PipesReady(newest.revision, product_of(pipes, boq)))
