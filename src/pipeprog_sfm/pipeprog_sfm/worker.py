"""The process that reconstructs: bundle adjustment holds Python's lock for seconds, which a node cannot afford."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.board import Board
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.mapper import FrameTie
from pipeprog_sfm.reconstruction import MetricMap, NotMetricError, Reconstruction, Status


@dataclass(frozen=True)
class Keyframe:
    """Command: take this keyframe; `encoded` holds JPEG or PNG bytes."""

    stamp: int
    encoded: bytes
    camera: Camera


@dataclass(frozen=True)
class Retire:
    """Command: take these keyframes out of the map."""

    stamps: tuple[int, ...]


@dataclass(frozen=True)
class Finish:
    """Command: no more keyframes come; publish the final map."""


@dataclass(frozen=True)
class KeyframeDone:
    """Event: a keyframe is worked off."""

    stamp: int
    status: Status
    ties: list[FrameTie]


@dataclass(frozen=True)
class Retired:
    """Event: a Retire is worked off."""

    status: Status
    ties: list[FrameTie]


@dataclass(frozen=True)
class MapReady:
    """Event: the map has changed."""

    status: Status
    map: MetricMap


@dataclass(frozen=True)
class Finished:
    """Event: the answer to Finish; `problem` is empty when the final map has been sent."""

    status: Status
    problem: str


def serve(connection: Connection, config: SfmConfig, boards: Sequence[Board]) -> None:
    """Works off commands from `connection` until it closes."""
    reconstruction = Reconstruction(config, boards)
    since_map = 0
    while True:
        command = connection.recv()
        if isinstance(command, Keyframe):
            try:
                reconstruction.add(command.stamp, command.encoded, command.camera)
            except InputError as error:
                reconstruction.skip(command.stamp, str(error))
            connection.send(KeyframeDone(command.stamp, reconstruction.status(), reconstruction.ties()))
            since_map += 1
            if since_map >= config.map_interval and not connection.poll():
                since_map = 0
                _send_map(connection, reconstruction)
        elif isinstance(command, Retire):
            reconstruction.retire(command.stamps)
            connection.send(Retired(reconstruction.status(), reconstruction.ties()))
        else:
            reconstruction.finish()
            problem = _send_map(connection, reconstruction)
            connection.send(Finished(reconstruction.status(), problem))


def _send_map(connection: Connection, reconstruction: Reconstruction) -> str:
    """Sends the map, or returns why there is none."""
    try:
        metric_map = reconstruction.metric_map()
    except NotMetricError as error:
        return str(error)
    connection.send(MapReady(reconstruction.status(), metric_map))
    return ""
