# SPDX-License-Identifier: Apache-2.0
"""The loop of the reconstruction's process: commands of the node in, events for the node out.

A process of its own, for two reasons. Its Python code would compete with the node's callbacks for the interpreter lock;
no single call keeps the lock for long: the compiled adjustment, pycolmap's pose estimation and OpenCV release it, and
SuperLU's factorisation keeps it for a part of its time only (0.2 of 0.8 s for 400 views, measured). And what crashes
or exhausts the memory ends this process, not the node, which then starts another one.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.alignment.map_file import MAP_FILE, write_map
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.inbox import Inbox
from pipeprog_sfm.metric.transform_tree import RobotMotion
from pipeprog_sfm.reconstruction import MetricMap, NotMetricError, Reconstruction, Status, Trajectory
from pipeprog_sfm.sparse.overlap import OverlapReport
from pipeprog_sfm.warm_up import warm_up

IDLE_SECONDS = 1.0  # since a keyframe came, after which a map is published early: the next one may never come
# Since a keyframe came, after which no map is made or sent that is not of all there is: those of a walking camera come
# at 2 to 3 Hz, and where none comes any more the last map, and its pipes, would wait for this one.
HOLD_SECONDS = 0.5
# Since a command was worked off, until which one that follows from it may come: some keyframes are retired then.
ANSWER_SECONDS = 0.3
POLL_SECONDS = 0.1  # between checks whether the requested map is finished


@dataclass(frozen=True)
class AddKeyframe:
    """Command: add this keyframe; `encoded` holds JPEG or PNG bytes, `motion` what came since the keyframe before."""

    stamp: int
    encoded: bytes
    camera: Camera
    frame: str = ""
    motion: RobotMotion = field(default_factory=RobotMotion)

    @property
    def content(self) -> tuple[bytes, Camera]:
        """What is recognised when it comes again, under another stamp, too."""
        return self.encoded, self.camera


@dataclass(frozen=True)
class Retire:
    """Command: take these keyframes out of the map."""

    stamps: tuple[int, ...]
    content: None = None  # nothing of it is to be recognised when it comes again, as of Finish


@dataclass(frozen=True)
class Finish:
    """Command: no more keyframes come; publish the final map.

    colmap: folder for the sparse model, beside which the map of the survey goes; empty: neither is written.
    """

    motion: RobotMotion = field(default_factory=RobotMotion)
    colmap: str = ""
    content: None = None


@dataclass(frozen=True)
class Ready:
    """Event: keyframes are processed from now on."""


@dataclass(frozen=True)
class KeyframeDone:
    """Event: a keyframe was processed; the trajectory is None while there is no scale or only a map is wanted."""

    stamp: int
    frame: str
    status: Status
    overlaps: list[OverlapReport]
    trajectory: Trajectory | None


@dataclass(frozen=True)
class Retired:
    """Event: a Retire was processed."""

    status: Status
    overlaps: list[OverlapReport]


@dataclass(frozen=True)
class MapReady:
    """Event: the map has changed; a `final` one is that of Finish."""

    status: Status
    map: MetricMap
    final: bool = False


@dataclass(frozen=True)
class Finished:
    """Event: the answer to Finish; `problem` is empty when the final map has been sent."""

    status: Status
    problem: str


Command = AddKeyframe | Retire | Finish
Event = Ready | KeyframeDone | Retired | MapReady | Finished


class Channel(Protocol):
    """What the loop needs of a multiprocessing connection."""

    def poll(self, timeout: float | None) -> bool:
        """Waits for a command, for `timeout` seconds or, with None, for ever; whether one has come."""

    def recv(self) -> Command:
        """Takes the next command; raises EOFError when the other end is closed."""

    def send(self, event: Event) -> None:
        """Sends an event."""


def serve(
    connection: Connection,
    config: SfmConfig,
    board_file: BoardFile,
    intermediate: bool,
    reference: SurveyMap | None,
    ahead: bool,
    answered: Iterable[AddKeyframe | Retire],
) -> None:
    """Processes commands from `connection` until it closes; those that a predecessor has answered come first.

    Without `intermediate`, the only map is the one that Finish asks for, in the frame of the reference if there is one;
    as no keyframe is waited for, what each stage needs is loaded when its turn comes.
    With `ahead`, images that have come are prepared while the ones before are worked off; with intermediate maps the
    other cores make these. Should the process die of one of the images, it is not told of which.
    """
    if intermediate:
        warm_up(config)
    reconstruction = Reconstruction(config, board_file, reference=reference)

    def expect(command: Command) -> None:
        if isinstance(command, AddKeyframe):
            reconstruction.expect(command.stamp, command.encoded, command.camera)

    channel: Channel = Inbox(connection, expect) if ahead and not intermediate else connection
    try:
        work(channel, reconstruction, config.map_interval if intermediate else None, answered)
    finally:
        reconstruction.close()


def work(
    channel: Channel,
    reconstruction: Reconstruction,
    map_interval: int | None,
    answered: Iterable[AddKeyframe | Retire],
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """As `serve`; `clock` tells seconds.

    A map is requested after `map_interval` keyframes, and one of all depth maps that can be made by then when all
    commands are worked off and no keyframe has come for IDLE_SECONDS; with None, no map but the last. Once none has
    come for HOLD_SECONDS the others are not requested, and one that is finished then is sent when the next keyframe
    comes, or not at all where the one of all depth maps follows. With None no poses are told before the map either.
    """
    posed = map_interval is not None
    for earlier in answered:
        _answer(reconstruction, earlier, posed)
        reconstruction.update_dense()
    channel.send(Ready())
    since_map, settled, heard, done = 0, True, clock(), clock()
    held: MapReady | None = None
    waiting: deque[Command] = deque()
    while True:
        worked = bool(waiting)
        if waiting:
            command = waiting.popleft()
            if isinstance(command, Finish):
                reconstruction.move(command.motion)
                channel.send(_finish(channel, reconstruction, command))
                since_map, settled, held = 0, True, None  # one after the last map would have a stamp without pipes
                continue
            channel.send(_answer(reconstruction, command, posed))
            if isinstance(command, AddKeyframe):
                reconstruction.update_dense()  # once the pose is out
                since_map, settled = since_map + 1, False
            done = clock()
        idle = map_interval is None or (settled and not reconstruction.is_mapping)
        patience = 0.0 if worked or waiting else None if idle else POLL_SECONDS
        came = _take(channel, waiting, patience)
        if any(isinstance(command, AddKeyframe) for command in came):
            heard = clock()
        if map_interval is None:
            continue
        try:
            finished = reconstruction.finished_map()
        except NotMetricError:
            finished, since_map = None, map_interval
        if finished is not None:
            held = MapReady(reconstruction.status(), finished)
        silence = clock() - heard
        if held is not None and (settled or silence < HOLD_SECONDS):
            channel.send(held)
            held = None
        at_rest = not (settled or waiting) and silence > IDLE_SECONDS and clock() - done > ANSWER_SECONDS
        due = worked and since_map >= map_interval and silence < HOLD_SECONDS
        if not reconstruction.is_mapping and (due or at_rest):
            settled, held = at_rest, None
            with contextlib.suppress(NotMetricError):  # the status says why, the next keyframe may measure the scale
                reconstruction.request_map(settled)
                since_map = 0


def _take(channel: Channel, waiting: deque[Command], patience: float | None) -> list[Command]:
    """Appends all commands that have come to those waiting, and returns them; waits up to `patience` [s] for the first.

    Raises EOFError when the other end is closed and no command is left.
    """
    came: list[Command] = []
    while channel.poll(0.0 if came else patience):
        try:
            came.append(channel.recv())
        except EOFError:
            if not (waiting or came):
                raise
            break  # what has come before the other end closed is worked off
    waiting.extend(came)
    return came


def _answer(reconstruction: Reconstruction, command: AddKeyframe | Retire, posed: bool) -> KeyframeDone | Retired:
    if isinstance(command, AddKeyframe):
        return _add(reconstruction, command, posed)
    reconstruction.retire(command.stamps)
    return Retired(reconstruction.status(), reconstruction.overlap_reports())


def _add(reconstruction: Reconstruction, keyframe: AddKeyframe, posed: bool) -> KeyframeDone:
    """Takes a keyframe; `posed`: poses are told as they stand, for which the scale is estimated."""
    reconstruction.move(keyframe.motion)
    try:
        reconstruction.add(keyframe.stamp, keyframe.encoded, keyframe.camera, keyframe.frame)
    except InputError as error:
        reconstruction.skip(keyframe.stamp, str(error))
    trajectory = None
    if posed:
        with contextlib.suppress(NotMetricError):  # the status says why
            trajectory = reconstruction.trajectory()
    overlaps = reconstruction.overlap_reports()
    return KeyframeDone(keyframe.stamp, keyframe.frame, reconstruction.status(), overlaps, trajectory)


def _finish(channel: Channel, reconstruction: Reconstruction, command: Finish) -> Finished:
    try:
        metric_map = reconstruction.finish()
    except NotMetricError as error:
        return Finished(reconstruction.status(), str(error))
    channel.send(MapReady(reconstruction.status(), metric_map, final=True))
    if command.colmap:
        folder = Path(command.colmap)
        reconstruction.write_colmap(folder)
        write_map(folder.parent / MAP_FILE, reconstruction.survey_map(metric_map.cloud))
    return Finished(reconstruction.status(), "")
