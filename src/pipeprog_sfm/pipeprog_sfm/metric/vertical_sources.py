# SPDX-License-Identifier: Apache-2.0
"""The sources of the vertical: an IMU, a board that hangs plumb, odometry's frame; failing these, floor and walls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from pipeprog_sfm.metric.gravity import GravityError, gravity
from pipeprog_sfm.metric.map_frame import Vertical, board_vertical, camera_up, path_vertical
from pipeprog_sfm.metric.scale import ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence
from pipeprog_sfm.metric.transform_tree import NoPathError
from pipeprog_sfm.metric.vertical_from_planes import vertical_from_planes


class VerticalSource(Protocol):
    """A source of the vertical: returns verticals, none where it knows none, and warnings; does not raise."""

    def __call__(self, posed: PosedEvidence, scale: float, /) -> Sequence[Vertical | ScaleWarning]:
        """Verticals in the model of `posed`, which has `scale` metres per unit, and warnings."""


def imu(posed: PosedEvidence, scale: float) -> list[Vertical | ScaleWarning]:
    """Up by gravity, from the accelerations of an IMU mounted beside the camera."""
    found: list[Vertical | ScaleWarning] = []
    camera_from_imu = {}
    for frame in sorted({one.frame for one in posed.seen.accelerations}):
        try:
            camera_from_imu[frame] = posed.seen.transforms.static_transform(posed.seen.camera_frame, frame)
        except NoPathError as error:
            found.append(ScaleWarning(str(error)))
    samples = [one for one in posed.seen.accelerations if one.frame in camera_from_imu]
    if not samples:
        return found
    forces = np.stack([camera_from_imu[one.frame][:3, :3] @ one.force for one in samples])
    try:
        return [*found, gravity(np.array([one.stamp for one in samples], np.int64), forces, posed.own_poses, scale)]
    except GravityError as error:
        return [*found, ScaleWarning(str(error))]


def plumb_board(posed: PosedEvidence, scale: float) -> list[Vertical | ScaleWarning]:
    """The y axis of the board that was seen first, where boards hang upright.

    Should neither board nor images tell which end of it is up, IMU or odometry do.
    """
    if not posed.boards.sound or not posed.board_config.upright:
        return []
    others = (one for source in (imu, odometry_frame) for one in source(posed, scale) if isinstance(one, Vertical))
    vertical, warning = board_vertical(posed.boards.sound[0], posed.poses, others)
    return [vertical, *([ScaleWarning(warning)] if warning else [])]


def odometry_frame(posed: PosedEvidence, scale: float) -> list[Vertical | ScaleWarning]:
    """The z axis of the frame that odometry moves in; its own problems are told by the source of scale."""
    try:
        path = posed.path
    except NoPathError:
        return []
    return [path_vertical(path, posed.poses)] if path is not None and len(path.stamps) else []


def floor_and_walls(posed: PosedEvidence) -> Vertical:
    """Up by the surroundings, for want of any other source; raises PlanesError where they do not tell it."""
    points = posed.points() if posed.points else np.empty((0, 3))
    return vertical_from_planes(points, camera_up(posed.poses))


VERTICAL_SOURCES: tuple[VerticalSource, ...] = (imu, plumb_board, odometry_frame)
