# SPDX-License-Identifier: Apache-2.0
"""What views along a wall show alike."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.view_overlap import FOR_THE_MOTION, in_image, is_shown_beside, view_overlap

CAMERA = Camera(240, 160, 220.0, 220.0, 119.5, 79.5)
STEP = 16  # px between two views of the wall at a distance of 1 m
WALL = np.c_[np.random.default_rng(1).uniform([-0.5, -0.35], [3.5, 0.35], (4000, 2)), np.ones(4000)]


def pose(place: int) -> FloatArray:
    matrix = np.eye(4)
    matrix[0, 3] = -place * STEP / CAMERA.fx
    return matrix


def test_overlap_is_the_share_seen_from_the_same_side() -> None:
    points = WALL[in_image(WALL, [(pose(4), CAMERA)])[0]]
    turned = pose(4)
    turned[:3, :3] = cv2.Rodrigues(np.array([0.0, np.pi, 0.0]))[0]
    nearer = pose(4)
    nearer[2, 3] = 0.5  # farther away: all of it, but smaller
    share = view_overlap(points, pose(4), [(other, CAMERA) for other in (pose(4), pose(5), pose(12), turned, nearer)])
    assert share[0] == 1.0
    assert share[1] == pytest.approx(1 - STEP / CAMERA.width, abs=0.03)
    assert share[2] == 0.0  # 31 degrees round
    assert share[3] == 0.0
    assert share[4] < 1.0
    assert len(view_overlap(points, pose(4), [])) == 0


@pytest.mark.parametrize("aside", [1, 2, 3])
def test_a_view_is_between_others_that_both_show_enough_of_it(aside: int) -> None:
    points = WALL[in_image(WALL, [(pose(4), CAMERA)])[0]]
    around = (pose(4 - aside), CAMERA), (pose(4 + aside), CAMERA)
    share = 1 - 2 * aside * STEP / CAMERA.width  # each lacks another side of it
    assert is_shown_beside(points, *around) == (share > FOR_THE_MOTION)
    assert is_shown_beside(points, around[0], around[0]) == (share + aside * STEP / CAMERA.width > FOR_THE_MOTION)
    assert not is_shown_beside(points[:0], *around)
