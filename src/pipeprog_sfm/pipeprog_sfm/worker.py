"""The process that reconstructs: bundle adjustment holds Python's lock for seconds, which a node cannot afford."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.metric.transform_tree import RobotMotion
from pipeprog_sfm.reconstruction import MetricMap, NotMetricError, Reconstruction, Status, Trajectory
from pipeprog_sfm.sparse.overlap import OverlapReport
from pipeprog_sfm.warm_up import warm_up

IDLE_SECONDS = 1.0  # without a command, after which a map goes out early: nobody knows when the next keyframe comes
POLL_SECONDS = 0.1  # between looks at the map under way


@dataclass(frozen=True)
class AddKeyframe:
    """Command: take this keyframe and the motion before it; `encoded` holds JPEG or PNG bytes."""

    stamp: int
    encoded: bytes
    camera: Camera
    frame: str = ""
    motion: RobotMotion = field(default_factory=RobotMotion)


@dataclass(frozen=True)
class Retire:
    """Command: take these keyframes out of the map."""

    stamps: tuple[int, ...]


@dataclass(frozen=True)
class Finish:
    """Command: no more keyframes come; publish the final map, and write the sparse model where a folder is named."""

    motion: RobotMotion = field(default_factory=RobotMotion)
    colmap: str = ""


@dataclass(frozen=True)
class Ready:
    """Event: keyframes are worked off without delay from now on."""


@dataclass(frozen=True)
class KeyframeDone:
    """Event: a keyframe is worked off; the trajectory is None while there is no scale."""

    stamp: int
    status: Status
    overlaps: list[OverlapReport]
    trajectory: Trajectory | None


@dataclass(frozen=True)
class Retired:
    """Event: a Retire is worked off."""

    status: Status
    overlaps: list[OverlapReport]


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


def serve(
    connection: Connection,
    config: SfmConfig,
    board_file: BoardFile,
    answered: Iterable[AddKeyframe | Retire],
) -> None:
    """Works off commands from `connection` until it closes; those that a predecessor has answered come before."""
    warm_up(config)
    reconstruction = Reconstruction(config, board_file)
    for command in answered:
        _answer(reconstruction, command)
        reconstruction.update_dense()
    connection.send(Ready())
    since_map, idle_since = 0, time.monotonic()
    while True:
        busy = since_map > 0 or reconstruction.is_mapping
        if connection.poll(POLL_SECONDS if busy else None):
            command = connection.recv()
            if isinstance(command, Finish):
                reconstruction.move(command.motion)
                connection.send(_finish(connection, reconstruction, command.colmap))
                since_map = 0  # another map after the last one would have a stamp that no pipes have
                continue
            connection.send(_answer(reconstruction, command))
            if isinstance(command, AddKeyframe):
                reconstruction.update_dense()  # once the pose is out
                since_map += 1
            idle_since = time.monotonic()
        try:
            metric_map = reconstruction.finished_map()
        except NotMetricError:
            metric_map, since_map = None, max(since_map, 1)
        if metric_map is not None:
            connection.send(MapReady(reconstruction.status(), metric_map))
        idle = since_map > 0 and time.monotonic() - idle_since > IDLE_SECONDS
        if not reconstruction.is_mapping and (since_map >= config.map_interval or idle):
            since_map = 0
            with contextlib.suppress(NotMetricError):  # the status tells
                reconstruction.request_map()


def _answer(reconstruction: Reconstruction, command: AddKeyframe | Retire) -> KeyframeDone | Retired:
    if isinstance(command, AddKeyframe):
        return _add(reconstruction, command)
    reconstruction.retire(command.stamps)
    return Retired(reconstruction.status(), reconstruction.overlap_reports())


def _add(reconstruction: Reconstruction, keyframe: AddKeyframe) -> KeyframeDone:
    reconstruction.move(keyframe.motion)
    try:
        reconstruction.add(keyframe.stamp, keyframe.encoded, keyframe.camera, keyframe.frame)
    except InputError as error:
        reconstruction.skip(keyframe.stamp, str(error))
    trajectory = None
    with contextlib.suppress(NotMetricError):  # the status tells
        trajectory = reconstruction.trajectory()
    return KeyframeDone(keyframe.stamp, reconstruction.status(), reconstruction.overlap_reports(), trajectory)


def _finish(connection: Connection, reconstruction: Reconstruction, colmap: str) -> Finished:
    try:
        metric_map = reconstruction.finish()
    except NotMetricError as error:
        return Finished(reconstruction.status(), str(error))
    connection.send(MapReady(reconstruction.status(), metric_map))
    if colmap:
        reconstruction.write_colmap(Path(colmap))
    return Finished(reconstruction.status(), "")
