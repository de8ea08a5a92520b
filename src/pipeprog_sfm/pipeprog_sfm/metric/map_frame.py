# SPDX-License-Identifier: Apache-2.0
"""The frame `map`: its origin at the board that was seen first, else at the first camera, and z up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board import symmetries
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.metric.transform_tree import CameraPath

MAX_STEEPNESS = np.cos(
    np.radians(30.0)
)  # cosine: a board's x axis closer to the vertical than 30 degrees gives no heading, so y is used
MAX_DISAGREEMENT = np.radians(
    5.0
)  # angle of two verticals that is worth a warning; a board hung by eye and an IMU are off by 1 to 2


@dataclass(frozen=True)
class Vertical:
    """The direction up: (3,) unit vector in the model, and its source, for people."""

    up_in_model: FloatArray
    source: str


def board_vertical(
    place: PlacedBoard, poses: Mapping[int, FloatArray], others: Iterable[Vertical] = ()
) -> tuple[Vertical, str]:
    """The y axis of a board that hangs plumb, and a warning or an empty text.

    Where the board looks the same upside down, the direction that is up in the images counts; where the camera was held
    nearer to lying than to upright, the first of the `others`, which are asked for only then.
    """
    up = camera_up({view.stamp: poses[view.stamp] for view in place.views})
    is_lying, is_symmetric = _is_steep(_axes(place), up), len(symmetries(place.board)) > 1
    known = next(iter(others), None) if is_lying and is_symmetric else None
    if known is not None:
        up = known.up_in_model
    place = _turned_up(place, up)
    axes = _axes(place)
    along = axes.T @ up
    text = ""
    if is_lying and is_symmetric and known is None:
        text = (
            f"which side of board {place.board.name} is up is not certain, and z of the map may point down: the board "
            "looks the same upside down, and the camera was held sideways, or the board hangs so: film upright, record "
            "an IMU or odometry, or hang a board that has no symmetry"
        )
    elif along[1] < abs(along[0]):
        tilt = abs(np.rad2deg(np.arctan2(along[0], along[1])))
        text = (
            f"board {place.board.name} hangs {tilt:.0f} degrees off upright as the camera was held, and the map's z "
            "axis with it: hang it upright, or set upright to false"
        )
    return Vertical(axes[:, 1], f"board {place.board.name}"), text


def _is_steep(axes: FloatArray, up: FloatArray) -> bool:
    """Whether a board's x axis is nearer to the vertical than its y axis, on either side."""
    return bool(abs(axes[:, 1] @ up) < abs(axes[:, 0] @ up))


def path_vertical(path: CameraPath, poses: Mapping[int, FloatArray]) -> Vertical:
    """The z axis of the frame that odometry moves in, which is up by REP 103."""
    ups = [
        poses[int(stamp)][:3, :3].T @ pose[2, :3]
        for stamp, pose in zip(path.stamps, path.fixed_from_camera, strict=True)
    ]
    up = np.mean(ups, axis=0)
    return Vertical(up / np.linalg.norm(up), f"frame '{path.fixed}'")


def camera_up(poses: Mapping[int, FloatArray]) -> FloatArray:
    """(3,) unit vector in the model: up as the cameras were held on average."""
    up = -np.mean([pose[1, :3] for pose in poses.values()], axis=0)
    return up / np.linalg.norm(up)


def map_from_model(
    scale: float, place: PlacedBoard | None, verticals: Sequence[Vertical], poses: Mapping[int, FloatArray]
) -> tuple[FloatArray, str, tuple[str, ...]]:
    """(4, 4) similarity map_from_model, a description of the frame for people, and warnings.

    z is the first of the verticals; others that disagree are warned about. With a board its origin is the origin and
    x runs along it, else the first camera is the origin and x runs to its right; y points into the scene either way.

    Args:
        scale: metres per model unit.
        place: the board at the origin.
        verticals: one or more, the best first.
        poses: (4, 4) camera_from_model by stamp, in order of time.
    """
    vertical = verticals[0]
    if place is not None:
        place = _turned_up(place, vertical.up_in_model)
        axes, origin, where = _axes(place), place.model_from_board[:3, 3], f"board {place.board.name}"
    else:
        first = next(iter(poses.values()))
        axes, origin, where = first[:3, :3].T * [1.0, -1.0, -1.0], -first[:3, :3].T @ first[:3, 3], "first keyframe"
    up = vertical.up_in_model
    ahead = axes[:, 0] if abs(axes[:, 0] @ up) < MAX_STEEPNESS else axes[:, 1]
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    linear = scale * np.stack([x, np.cross(up, x), up])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = linear, -linear @ origin
    warnings = tuple(
        f"z of the map is up by {vertical.source}, and {np.degrees(angle):.0f} degrees off up by {other.source}: "
        "one of the two is wrong"
        for other in verticals[1:]
        if (angle := np.arccos(np.clip(other.up_in_model @ up, -1.0, 1.0))) > MAX_DISAGREEMENT
    )
    return frame, f"origin: {where}, z up: {vertical.source}", warnings


def _axes(place: PlacedBoard) -> FloatArray:
    """(3, 3) rotation model_from_board."""
    return place.model_from_board[:3, :3] * place.scale


def _turned_up(place: PlacedBoard, up: FloatArray) -> PlacedBoard:
    """The board with its y axis up, turned if need be and if it looks the same upside down."""
    if _axes(place)[:, 1] @ up >= 0 or len(symmetries(place.board)) == 1:
        return place
    return place.upside_down()
