# SPDX-License-Identifier: Apache-2.0
"""What the rows of a walk's views correct of a spline's velocities, with errors of both as they are in walks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.model.row_corrections import SPLINE_SIGMA, corrections
from pipeprog_sfm.model.row_fit import RowFit

COUNT = 60
TIMES: FloatArray = 0.2 * np.arange(COUNT, dtype=np.float64)
DEPTH = 2.0  # m
NOISE = np.repeat([0.004, 0.008], 3)  # rad/s, m/s, of the velocity that the rows of a view tell
SLOW = np.repeat([0.02, 0.04], 3)  # by which a bent scene has all of them off
AT_REST = np.tile(np.eye(3), (COUNT, 1, 1))
TURNING = Rotation.from_euler("y", 0.1 * np.arange(COUNT)).as_matrix()  # rad from one view to the next


def told(changes: FloatArray) -> list[RowFit]:
    """Fits whose rows tell these (N, 6) changes, rad/s and m/s."""
    rest = RowMotion(0.02, 720, np.zeros(3), np.zeros(3))
    precision = np.repeat([1.0, 1.0 / DEPTH**2], 3)
    return [RowFit(rest, change, np.diag(1.0 / NOISE**2), precision, 0.2) for change in changes]


def errors(found: FloatArray, true: FloatArray) -> FloatArray:
    """Root mean square over the inner views, rad/s and depths of the scene per second."""
    return np.asarray(np.sqrt(((found - true)[5:-5] ** 2).mean(axis=0)) / np.repeat([1.0, DEPTH], 3))


@pytest.fixture
def noise() -> FloatArray:
    return np.random.default_rng(3).normal(0.0, 1.0, (COUNT, 6)) * NOISE


def turns() -> FloatArray:
    """(N, 6) errors of a spline in the turns of a fast walk: they alternate, and are small elsewhere."""
    true = np.zeros((COUNT, 6))
    for first in (12, 30, 45):
        true[first : first + 4] = np.outer([0.25, -0.75, 0.75, -0.25], [0.03, 0.04, 0.0, 0.08, 0.06, 0.0])
    return true


def test_what_alternates_is_the_rows_and_what_bends_the_scene_is_not(noise: FloatArray) -> None:
    true = turns()
    found = corrections(told(true + noise + SLOW), TIMES, AT_REST, np.zeros(COUNT))
    left, at_first = errors(found, true), errors(np.zeros_like(true), true)
    assert (left < 0.006).all(), "the slow error alone is 0.02"
    assert (left < 0.7 * at_first)[[0, 1, 3, 4]].all()


def test_a_steady_walk_is_the_splines(noise: FloatArray) -> None:
    """Its error is below SPLINE_SIGMA: what rows tell is their noise."""
    found = corrections(told(noise), TIMES, TURNING, np.zeros(COUNT))
    assert (errors(found, np.zeros_like(found)) < 0.7 * SPLINE_SIGMA).all()


def test_velocities_are_averaged_in_one_frame() -> None:
    """A velocity that is the same in the room is another one in each camera of a turn: it is slow all the same."""
    slow = np.einsum("nij,j->ni", TURNING, [0.05, 0.0, 0.02])
    found = corrections(told(np.c_[slow, slow]), TIMES, TURNING, np.zeros(COUNT))
    assert np.abs(found[5:-5]).max() < 0.005


def test_a_jerk_leaves_the_views_around_it_alone(noise: FloatArray) -> None:
    true = np.zeros((COUNT, 6))
    true[25, 3] = 0.5
    found = corrections(told(true + noise), TIMES, AT_REST, np.zeros(COUNT))
    around: NDArray[np.intp] = np.r_[20:25, 26:31]
    assert np.abs(found[around, 3]).max() < 3.0 * NOISE[3]
    assert found[25, 3] == pytest.approx(0.5, abs=4.0 * NOISE[3])


def test_a_view_without_rows_keeps_the_splines_velocity(noise: FloatArray) -> None:
    fits = told(noise)
    fits[30] = RowFit(fits[30].motion, np.zeros(6), np.zeros((6, 6)), np.ones(6), 0.2)
    found = corrections(fits, TIMES, TURNING, np.zeros(COUNT))
    assert np.abs(found[30]).max() < SPLINE_SIGMA
