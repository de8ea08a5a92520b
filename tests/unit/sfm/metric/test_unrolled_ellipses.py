# SPDX-License-Identifier: Apache-2.0
"""Boards seen through a rolling shutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from targets import BOARD, CAMERA, camera_from_board, exact_ellipses

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.boards.board import Board, BoardObservation
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.ellipses import PROFILES, ImageEllipses, fit_ellipses, rim_points
from pipeprog_sfm.boards.placed_board import BoardView, PlacedBoard
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.metric import metric_tracker
from pipeprog_sfm.metric.metric_tracker import MetricTracker
from pipeprog_sfm.metric.unrolled_ellipses import RollingViews, unrolled_ellipses

MOTION = RowMotion(0.03, CAMERA.height, np.array([-0.8, 0.1, 0.05]), np.array([0.05, -0.2, 0.1]))


def rolled(ellipses: ImageEllipses, pose: np.ndarray) -> ImageEllipses:
    """What the rolling camera sees of ellipses on the board's plane."""
    rims = rim_points(ellipses.centres, ellipses.shapes)[0].reshape(-1, 2)
    rays = np.c_[(rims - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(rims))]
    inside = rays * (pose[:3, 2] @ pose[:3, 3] / (rays @ pose[:3, 2]))[:, None]
    shown = RolledImage(MOTION, CAMERA).shown(rims, inside[:, 2]).reshape(-1, PROFILES, 2)
    centres, shapes, rms, _ = fit_ellipses(shown, np.ones(shown.shape[:2]))
    return ImageEllipses(centres, shapes, rms)


def test_circles_are_unrolled_by_the_plane_of_their_board() -> None:
    pose = camera_from_board((0.5, 0.1, 1.4), (0.0, 0.0, 0.0))
    true = exact_ellipses([BOARD], [pose])
    seen = rolled(true, pose)
    assert np.abs(seen.centres - true.centres).max() > 1.0
    near_wall = np.array([[0.0, 0.0, -0.1], [0.3, 0.2, -0.1], [-0.3, -0.2, -0.1]])

    def place(ellipses):
        views = tuple(BoardView(7, found) for found in detect_boards(ellipses[7], [BOARD], CAMERA))
        assert len(views) == 1
        return ellipses, [PlacedBoard(BOARD, views, np.eye(4), 0.0, 0.03, 0.1)]

    found = unrolled_ellipses(
        {7: seen, 8: seen}, {7: CAMERA, 8: CAMERA}, {7: pose}, RollingViews({7: MOTION}, lambda _: near_wall), place
    )
    # What the wall behind the board would give is a tenth of a pixel off.
    np.testing.assert_allclose(found[7].centres, true.centres, atol=0.02)
    np.testing.assert_allclose(found[7].axes, true.axes, atol=0.02)
    assert found[8] is seen


def test_boards_are_sought_again_only_where_their_circles_have_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = {n: camera_from_board((0.3 * n - 0.3, 0.1, 1.4), (0.0, 0.0, 0.0)) for n in range(3)}
    shown = iter([rolled(exact_ellipses([BOARD], [pose]), pose) for pose in poses.values()])
    sought: list[ImageEllipses] = []

    def seek(ellipses: ImageEllipses, boards: Sequence[Board], camera: Camera) -> list[BoardObservation]:
        sought.append(ellipses)
        return detect_boards(ellipses, boards, camera)

    monkeypatch.setattr(metric_tracker, "detect_ellipses", lambda *_: next(shown))
    monkeypatch.setattr(metric_tracker, "detect_boards", seek)
    tracker = MetricTracker(BoardFile([BOARD]), BoardConfig())
    for stamp in poses:
        tracker.add(stamp, np.zeros((2, 2), np.uint8), CAMERA)
    on_board = np.array([[0.1, 0.1, 0.0], [-0.1, -0.1, 0.0], [0.1, -0.1, 0.0]])
    moved = replace(MOTION, angular=1.02 * MOTION.angular)  # by 0.01 px
    far = replace(MOTION, angular=MOTION.angular + np.array([0.0, 1.5, 0.0]))  # no board fits
    counts = []
    for motion in (MOTION, MOTION, moved, far):
        sought.clear()
        misfit = tracker.board_misfit(poses, RollingViews(dict.fromkeys(poses, motion), lambda _: on_board))
        counts.append(len(sought))
        assert motion is far or misfit is not None
    assert counts == [3, 0, 0, 3]
