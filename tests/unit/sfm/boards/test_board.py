# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from targets import BOARD, LOPSIDED

from pipeprog_sfm.boards.board import layouts, symmetries


def test_symmetries():
    assert symmetries(BOARD).tolist() == [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0]]
    assert symmetries(LOPSIDED).tolist() == [[0, 1, 2, 3, 4]]


def test_boards_that_look_alike_are_of_one_layout():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(BOARD, name="turned", centres=BOARD.centres @ turn.T + [0.1, 0.2, 0.0])
    larger = replace(BOARD, name="larger", circle_radius=1.5 * BOARD.circle_radius)
    mirrored = replace(LOPSIDED, name="mirrored", centres=LOPSIDED.centres * [-1.0, 1.0, 1.0])
    found = layouts([BOARD, LOPSIDED, turned, larger, mirrored])
    assert [[board.name for board in group] for group in found] == [["A", "turned"], ["B"], ["larger"], ["mirrored"]]
