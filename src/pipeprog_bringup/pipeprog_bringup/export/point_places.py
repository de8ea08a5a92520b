# SPDX-License-Identifier: Apache-2.0
"""Where control points lie in the map: circles of boards and pixels of keyframes, by rays from several keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeprog_bringup.export.control_points import ControlPoint
from pipeprog_bringup.export.keyframes import Keyframe, keyframes
from pipeprog_bringup.results.results_reader import Results
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.board_triangulation import place_boards
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.boards.placed_board import PosedCamera
from pipeprog_sfm.config import BoardConfig

# Of the sum of squared sines of the rays' angles to their mean: a pair 3 degrees apart. With less, a pixel moves the
# point by forty times what it moves in the image's plane.
_LEAST_PARALLAX = 1e-3
_OFF = 5.0  # px from a point's pixel to where its other keyframes put it; a careful click is off by one


def points_in_map(points: Sequence[ControlPoint], results: Results, boards: BoardFile) -> FloatArray:
    """Places (N, 3) of control points in the map [m]; `boards` has the boards whose circles they name.

    Raises InputError, naming the point and the remedy, where a place cannot be had.
    """
    frames = list(keyframes(results))
    circles = _circles(frames, boards) if any(point.circle for point in points) else {}
    places = []
    for point in points:
        if point.pixels:
            places.append(_by_pixels(point, frames))
        elif point.circle in circles:
            places.append(circles[point.circle])
        else:
            known = ", ".join(circles) or "none; give the boards with --board"
            raise InputError(
                f"control point {shown(point.name)}: circle {shown(point.circle)} was not found in the keyframes; "
                f"found were: {known}"
            )
    return np.array(places)


def _circles(frames: Sequence[Keyframe], boards: BoardFile) -> dict[str, FloatArray]:
    """Places of the boards' circles by `BOARD/NUMBER`."""
    if not boards.boards or not frames:
        return {}
    camera = frames[0].camera
    ellipses, seen = {}, {}
    for frame in frames:
        if frame.camera == camera:
            grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8)
            ellipses[frame.stamp] = detect_ellipses(grey, camera, BoardConfig())
            seen[frame.stamp] = detect_boards(ellipses[frame.stamp], boards.boards, camera)
    from_map = {frame.stamp: np.asarray(np.linalg.inv(frame.pose), np.float64) for frame in frames}
    posed = PosedCamera(camera, from_map)
    return {
        f"{place.board.name}/{number}": circle
        for place in place_boards(seen, posed, boards.boards, ellipses)
        for number, circle in enumerate(place.circles_in_model, 1)
    }


def _by_pixels(point: ControlPoint, frames: Sequence[Keyframe]) -> FloatArray:
    """The point (3,) nearest to the rays through its pixels."""
    by_number = {frame.number: frame for frame in frames}
    where = f"control point {shown(point.name)}"
    normal, right, directions = np.zeros((3, 3)), np.zeros(3), []
    for number, *pixel in point.pixels:
        frame = by_number.get(number)
        if frame is None:
            raise InputError(
                f"{where}: there is no keyframe {number}: they are lines 1 to {max(by_number)} of trajectory.tum"
            )
        camera = frame.camera
        ((u, v),) = camera.undistort_points([pixel])
        ray = frame.pose[:3, :3] @ [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ frame.pose[:3, 3]
        directions.append(ray)
    if np.linalg.eigvalsh(normal)[0] < _LEAST_PARALLAX:
        raise InputError(f"{where}: its keyframes look from nearly one place: add one from further aside")
    place = np.linalg.solve(normal, right)
    for number, *pixel in point.pixels:
        frame = by_number[number]
        in_camera = frame.pose[:3, :3].T @ (place - frame.pose[:3, 3])
        ideal = in_camera[:2] / in_camera[2] * [frame.camera.fx, frame.camera.fy] + [frame.camera.cx, frame.camera.cy]
        off = float(np.linalg.norm(frame.camera.distort_points([ideal])[0] - pixel))
        if in_camera[2] <= 0.0 or not off <= _OFF:
            raise InputError(
                f"{where}: in keyframe {number} it lies {off:.0f} px from where the others put it: check the pixels"
            )
    return np.asarray(place)
