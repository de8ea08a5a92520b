# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_bringup.report.viewer_data import board_lines

ROUNDING = 1e-6  # m; the rectangle is sought in float32


@given(st.integers(0, 2**32 - 1))
def test_a_board_is_drawn_in_its_plane_around_its_circles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed).as_matrix(), rng.uniform(-5, 5, 3)
    flat = np.array([[0, 0], [0.1, 0], [0.2, 0], [0, 0.15], [0.2, 0.15]])
    edge, *circles = board_lines(np.c_[flat, np.zeros(5)] @ turn.T + shift)
    assert len(circles) == 5
    there = [(line - shift) @ turn for line in (edge, *circles)]
    assert np.abs(np.concatenate(there)[:, 2]).max() < ROUNDING
    np.testing.assert_allclose(there[1] - [*flat[0], 0], there[2] - [*flat[1], 0], atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.norm(there[1][:, :2] - flat[0], axis=1), 0.025, atol=ROUNDING)
    np.testing.assert_allclose(there[0][:, :2].min(axis=0), [-0.05, -0.05], atol=1e-5)
    np.testing.assert_allclose(there[0][:, :2].max(axis=0), [0.25, 0.2], atol=1e-5)
