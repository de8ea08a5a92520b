# SPDX-License-Identifier: Apache-2.0
"""When circles that lie beside their places refuse a board."""

import numpy as np
import pytest
from targets import BOARD

from pipeprog_sfm.boards.board_check import FALSE_ALARM, CircleResiduals, contradiction
from pipeprog_sfm.boards.placed_board import PlacedBoard

PLACE = PlacedBoard(BOARD, (), np.eye(4), 0.0, 0.1, 0.1)
SIGMA, TOLERANCE = 3e-4, 4e-4  # m, which make 5e-4 together


def refused(offsets: np.ndarray) -> bool:
    return contradiction(PLACE, CircleResiduals(offsets, np.full(offsets.shape, SIGMA)), TOLERANCE) != ""


def test_sound_boards_are_refused_as_often_as_is_said() -> None:
    """Of 100 000 circles 10 +- 3.2 at a probability of 1 in 10 000."""
    offsets = np.random.default_rng(0).normal(0.0, 5e-4, (100_000, 1, 3))
    squares = (offsets**2).sum(axis=(1, 2)) / 5e-4**2
    suspects = offsets[squares > 12.0]  # the others are far below any threshold
    expected = FALSE_ALARM * len(offsets)
    assert sum(refused(offset) for offset in suspects) == pytest.approx(expected, abs=3.0 * np.sqrt(expected))


@pytest.mark.parametrize(("offset_mm", "is_refused"), [(2.2, False), (2.4, True)])
def test_a_circle_may_be_off_by_what_its_sigma_and_the_tolerance_allow(offset_mm: float, is_refused: bool) -> None:
    """sqrt(chi square of 3 degrees of freedom at 1e-4) = 4.59 standard deviations of 0.5 mm: 2.30 mm."""
    offsets = np.full((5, 3), np.nan)
    offsets[:3] = 0.0
    offsets[1, 0] = 1e-3 * offset_mm
    assert refused(offsets) == is_refused
