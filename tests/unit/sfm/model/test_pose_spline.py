# SPDX-License-Identifier: Apache-2.0
"""Velocities and accelerations by a spline, beside those of the path that the poses are of."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import rates_of
from scipy.spatial.transform import Rotation

from pipeprog_sfm.model.pose_spline import MIN_GAP, spline_rates

STEP = 200_000_000  # ns between views
TICK = 1e-4  # s of numerical derivatives
SWAY = 2.0 * np.pi * 1.0  # rad/s
# Of the amplitude: through five poses a cycle, a spline of degree 5 is off by 0.0016 and 0.0047 far from its ends.
VELOCITY_ERROR, ACCELERATION_ERROR = 0.003, 0.01


def path(times: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations camera_from_model and centres of a walk at 0.8 m/s that sways by 50 mm and 0.05 rad."""
    swayed = np.sin(SWAY * times)
    centres = np.c_[0.8 * times, 0.05 * swayed, 0.02 * swayed]
    turns = Rotation.from_rotvec(np.c_[0.02 * swayed, 0.05 * swayed + 0.1 * times, 0.0 * times])
    return turns.as_matrix(), centres


def true_rates(time: float) -> list[NDArray[np.float64]]:
    """As `spline_rates` of one view, by differences of the path."""
    rotations, centres = path(time + TICK * np.array([-1.0, 0.0, 1.0]))
    poses = np.concatenate([rotations, -rotations @ centres[..., None]], axis=2)
    return rates_of(*poses, TICK)


def test_the_rates_are_those_of_the_path() -> None:
    times = np.arange(24) * 0.2
    rates = spline_rates([n * STEP for n in range(24)], *path(times))
    for view in range(8, 16):
        linear, angular, bent, twisted = true_rates(times[view])
        assert rates[0][view] == pytest.approx(linear, abs=VELOCITY_ERROR * 0.05 * SWAY)
        assert rates[1][view] == pytest.approx(angular, abs=VELOCITY_ERROR * 0.05 * SWAY)
        assert rates[2][view] == pytest.approx(bent, abs=ACCELERATION_ERROR * 0.05 * SWAY**2)
        assert rates[3][view] == pytest.approx(twisted, abs=ACCELERATION_ERROR * 0.05 * SWAY**2)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3), st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3))
def test_the_rates_do_not_depend_on_the_frame_of_the_model(turn: list[float], moved: list[float]) -> None:
    stamps = [n * STEP for n in range(8)]
    rotations, centres = path(np.arange(8) * 0.2)
    model_from_other = Rotation.from_rotvec(turn).as_matrix()
    others = spline_rates(stamps, rotations @ model_from_other, (centres - moved) @ model_from_other)
    for other, own in zip(others, spline_rates(stamps, rotations, centres), strict=True):
        assert other == pytest.approx(own, abs=1e-9)


def test_a_view_right_after_another_is_no_knot() -> None:
    times = np.array([0.0, 0.2, 0.4, 0.4 + MIN_GAP / 2, 0.6, 0.8])
    rotations, centres = path(times)
    noisy = centres.copy()
    noisy[3] += 0.01  # m, which would be 1 m/s over the gap
    stamps = [round(time * 1e9) for time in times]
    for moved, own in zip(
        spline_rates(stamps, rotations, noisy), spline_rates(stamps, rotations, centres), strict=True
    ):
        assert moved == pytest.approx(own)


def test_two_views_tell_a_line() -> None:
    linear, angular, bent, twisted = spline_rates(
        [0, STEP], np.tile(np.eye(3), (2, 1, 1)), np.array([[0, 0, 0], [0.2, 0, 0]])
    )
    assert linear == pytest.approx(np.tile([-1.0, 0.0, 0.0], (2, 1)))
    for none in (angular, bent, twisted):
        assert none == pytest.approx(np.zeros((2, 3)), abs=1e-12)


def test_one_view_tells_nothing() -> None:
    assert all(rates.shape == (0, 3) for rates in spline_rates([0], np.eye(3)[None], np.zeros((1, 3))))
