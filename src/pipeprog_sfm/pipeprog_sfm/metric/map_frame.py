"""The frame `map`: its origin at the first board that was seen, or at the start, and z up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board import symmetries
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.metric.transform_tree import CameraPath

MAX_STEEPNESS = np.cos(np.radians(30.0))  # an axis nearer to the vertical tells no heading
MAX_DISAGREEMENT = np.radians(5.0)  # of two verticals: more than a board hung by eye or a cheap accelerometer errs by


@dataclass(frozen=True)
class Vertical:
    """The direction up: (3,) unit vector in the model, and what it is from, for people."""

    up_in_model: FloatArray
    source: str


def board_vertical(place: PlacedBoard, poses: Mapping[int, FloatArray]) -> tuple[PlacedBoard, Vertical, str]:
    """The y axis of a board that hangs plumb, and a warning or an empty text.

    A board that looks the same upside down is turned to have its y axis up as the cameras were held.
    """
    up = camera_up({view.stamp: poses[view.stamp] for view in place.views})
    place = _turned_up(place, up)
    axes = _axes(place)
    along = axes.T @ up
    text = ""
    if along[1] < abs(along[0]):
        tilt = abs(np.rad2deg(np.arctan2(along[0], along[1])))
        text = (
            f"board {place.board.name} hangs {tilt:.0f} degrees off upright as the camera was held, and the map's z "
            "axis with it: hang it upright, or set upright to false"
        )
    return place, Vertical(axes[:, 1], f"board {place.board.name}"), text


def path_vertical(path: CameraPath, poses: Mapping[int, FloatArray]) -> Vertical:
    """The z axis of the frame that odometry moves in, which REP 103 has up."""
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
    """(4, 4) similarity, what the frame is, and warnings.

    z is the first of the verticals, the others must agree. With a board the origin is its origin and x runs along it,
    else the origin is the first camera's place and x runs to its right; y points into the scene either way.

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
    """The board with its y axis up, where that cannot be told from upside down."""
    if _axes(place)[:, 1] @ up >= 0 or len(symmetries(place.board)) == 1:
        return place
    return place.upside_down()
