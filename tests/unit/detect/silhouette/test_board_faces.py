# SPDX-License-Identifier: Apache-2.0
"""Boards hide what is behind them, although stereo shows nothing of their plain faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_detect.silhouette.board_faces import LARGEST, NEIGHBOURS, SPACING, board_faces
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.silhouette.scene import Scene
from tests.unit.detect.straight_ahead import level, looking_along_y

RADIUS = 0.04
CENTRES = np.array([[-0.21, 0.11], [0.21, 0.11], [0.07, 0.02], [-0.21, -0.11], [0.21, -0.11]])


def board(x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Centres (5, 3) of the circles of a board that faces the cameras, its middle at x and y."""
    return np.column_stack([CENTRES[:, 0] + x, np.full(5, y), CENTRES[:, 1]])


@given(st.integers(0, 1000), st.floats(-100.0, 100.0))
def test_a_face_lies_within_its_circles(seed: int, far: float) -> None:
    rotation = Rotation.random(random_state=seed)
    faces = board_faces(rotation.apply(board()) + far, np.full(5, RADIUS))
    back = rotation.inv().apply(faces - far)
    assert np.abs(back[:, 1]).max() < 1e-6
    assert np.abs(back[:, 0]).max() == pytest.approx(0.21 + RADIUS, abs=2.0 * SPACING)
    assert np.abs(back[:, 2]).max() == pytest.approx(0.11 + RADIUS, abs=2.0 * SPACING)
    area = (0.42 + 2.0 * RADIUS) * (0.22 + 2.0 * RADIUS) - (4.0 - np.pi) * RADIUS**2
    assert len(faces) * SPACING**2 == pytest.approx(area, rel=0.03)


def test_boards_are_told_apart() -> None:
    two = np.vstack([board(-1.0), board(1.0)])
    faces = board_faces(two, np.full(10, RADIUS))
    assert len(faces) == pytest.approx(2 * len(board_faces(board(), np.full(5, RADIUS))), rel=0.01)
    assert not (np.abs(faces[:, 0]) < 0.7).any()


def test_what_is_no_board_hides_nothing() -> None:
    bent = board()
    bent[2, 1] += 2.0 * RADIUS
    apart = np.array([[0.0, 0.0, 0.0], [2.0 * NEIGHBOURS * RADIUS, 0.0, 0.0], [0.0, 0.0, 2.0 * NEIGHBOURS * RADIUS]])
    large = LARGEST * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for centres, radius in ((np.empty((0, 3)), RADIUS), (bent, RADIUS), (apart, RADIUS), (large, LARGEST)):
        assert board_faces(centres, np.full(len(centres), radius)).shape == (0, 3)


def test_the_contour_of_a_pipe_behind_a_board_is_not_missing() -> None:
    """Its middle is hidden from all views, its ends from none."""
    views = [replace(looking_along_y(x, number), nearest=None) for number, x in enumerate((-0.1, 0.0, 0.1))]
    pipe = level(1.0)
    none, faces = np.empty((0, 3)), board_faces(board(y=-0.2), np.full(5, RADIUS))
    assert Scene.of(pipe, with_depths(views, none), []).visible_share() == 1.0
    along = np.abs(Scene.of(pipe, with_depths(views, none, faces), []).samples().along)
    assert (along > 0.15).all()
    assert (along > 0.4).any()
