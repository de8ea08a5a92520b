# SPDX-License-Identifier: Apache-2.0
"""The process that detects: seconds of computing that the node's callbacks must not wait for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.rolled_image import RowVelocities
from pipeprog_detect.cloud.map_change import MapChange
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.look.colour_view import NO_CIRCLES, BoardCircles
from pipeprog_detect.look.told_by_look import Seen, told_by_look
from pipeprog_detect.overlapping_views import without_overlapping
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import asks_look
from pipeprog_detect.product.pipe_tracker import PipeTracker
from pipeprog_detect.product.product import Product, product_of
from pipeprog_detect.silhouette.board_faces import board_faces
from pipeprog_detect.types import Cloud, Cylinder, View
from pipeprog_detect.verification.measurement_cache import MeasurementCache


@dataclass(frozen=True)
class Keyframe:
    """Command: keep this keyframe for the outlines; `encoded` holds JPEG or PNG bytes."""

    stamp: int
    encoded: bytes
    camera: Camera

    @property
    def content(self) -> tuple[bytes, Camera]:
        """What is recognised when it comes again, under another stamp, too."""
        return self.encoded, self.camera


@dataclass(frozen=True)
class Retire:
    """Command: forget these keyframes, no map contains them any more; those that are not known are ignored."""

    stamps: tuple[int, ...]
    content: None = None  # nothing of it is to be recognised when it comes again


@dataclass(frozen=True)
class Map:
    """Command: detect in this map; poses (M, 4, 4) map_from_camera and velocities belong to stamps (M,).

    What is found in a `final` map does not depend on the maps before it. A `camera` replaces that of all keyframes.
    `circles` of the boards tell what is white, and what the boards hide.
    """

    revision: int
    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    stamps: NDArray[np.int64]
    map_from_camera: NDArray[np.float64]
    final: bool
    camera: Camera | None = None
    velocities: RowVelocities | None = None
    circles: BoardCircles = NO_CIRCLES

    @property
    def content(self) -> tuple[object, ...]:
        """What is recognised when it comes again, under another revision, too."""
        return self.points, self.normals, self.stamps, self.map_from_camera, self.camera, self.velocities


@dataclass(frozen=True)
class Ready:
    """Event: the keyframes that the predecessor had are taken."""


@dataclass(frozen=True)
class Decoding:
    """Event: this keyframe is being decoded; None: that is over, and the map is worked on."""

    stamp: int | None


@dataclass(frozen=True)
class KeyframeUnusable:
    """Event: a keyframe that a map contains is left out, and why."""

    stamp: int
    problem: str


@dataclass(frozen=True)
class PipesReady:
    """Event: the product of a map."""

    revision: int
    product: Product


@dataclass(frozen=True)
class NoPipes:
    """Event: no pipes can be sought in a map, and why."""

    revision: int
    problem: str


Event = Ready | Decoding | KeyframeUnusable | PipesReady | NoPipes


def serve(
    connection: Connection,
    config: DetectConfig,
    boq: BillOfQuantities,
    kept: Iterable[Keyframe | Retire],
    named: Mapping[str, Cylinder],
) -> None:
    """Works off commands from `connection` until it closes; a predecessor `kept` these and gave these names."""
    keyframes, identities, memory = Keyframes(), PipeTracker(named), MeasurementCache()
    for earlier in kept:
        _keep(earlier, keyframes, memory)
    connection.send(Ready())
    while True:
        command = connection.recv()
        if not isinstance(command, Map):
            _keep(command, keyframes, memory)
            continue
        if command.camera is not None and keyframes.replace_camera(command.camera):
            memory = MeasurementCache()
        views = list(_views(connection, command, keyframes, _measured_in(command, keyframes)))
        memory.next_map()
        if command.final:
            memory.novelty = MapChange()
        normals = None if command.normals is None else command.normals.astype(float)
        cloud = Cloud(command.points.astype(float), normals)
        boards = board_faces(command.circles.centres, command.circles.radii)
        try:
            pipes = detect(cloud, boq, config, views, memory=memory, boards=boards)
        except InputError as error:
            connection.send(NoPipes(command.revision, str(error)))
            continue
        if any(asks_look(pipe, boq, config.concave) for pipe in pipes):
            seen = Seen(views, keyframes.colour, cloud.points, command.circles)
            pipes = told_by_look(pipes, boq, seen, config.concave)
        # In the end the names are those of `detect`, by place: earlier ones depend on which maps came in between.
        if not command.final:
            pipes = identities.named(pipes)
        connection.send(PipesReady(command.revision, product_of(pipes, boq)))


def _keep(command: Keyframe | Retire, keyframes: Keyframes, memory: MeasurementCache) -> None:
    if isinstance(command, Keyframe):
        keyframes.add(command.stamp, command.encoded, command.camera)
        return
    for stamp in command.stamps:
        keyframes.remove(stamp)
    memory.forget_views(command.stamps)


def _measured_in(command: Map, keyframes: Keyframes) -> list[int]:
    """Numbers of the map's keyframes that are there, without those that a rolling shutter has for the motion alone."""
    there = [number for number, stamp in enumerate(command.stamps.tolist()) if stamp in keyframes]
    if command.velocities is None:
        return there
    poses = np.linalg.inv(command.map_from_camera)
    views = [(poses[number], keyframes.camera(int(command.stamps[number]))) for number in there]
    return [there[number] for number in without_overlapping(views, command.points)]


def _views(connection: Connection, command: Map, keyframes: Keyframes, numbers: Iterable[int]) -> Iterator[View]:
    """Keyframes of a map, by number, that can be decoded; says which one is, lest this process die of it unnoticed."""
    for number in numbers:
        stamp = int(command.stamps[number])
        if not keyframes.is_decoded(stamp):
            connection.send(Decoding(stamp))
        try:
            view = keyframes.view(stamp, command.map_from_camera[number])
            if command.velocities is not None:
                view = replace(view, rolled=command.velocities.rolled(number, keyframes.camera(stamp)))
            yield view
        except InputError as error:
            keyframes.remove(stamp)
            connection.send(KeyframeUnusable(stamp, str(error)))
    connection.send(Decoding(None))
