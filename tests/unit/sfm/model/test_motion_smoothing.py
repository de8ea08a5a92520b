# SPDX-License-Identifier: Apache-2.0
"""Motions of a walk by its poses and by rows of points seen on it, beside those of the path that both are of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import rates_of
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.model.motion_smoothing import smoothed
from pipeprog_sfm.model.pose_spline import MIN_GAP, spline_rates
from pipeprog_sfm.model.row_fit import ViewRows

READOUT, HEIGHT, FOCAL = 0.03, 720, 900.0  # s, px, px
NOISE = 0.1  # px
STEP = 0.2  # s between views
TICK = 1e-4  # s of numerical derivatives
INNER = slice(3, -3)  # views that an end does not touch

Path = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def walk(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations camera_from_model and centres of a walk at 0.8 m/s that sways by 20 mm and 0.02 rad at 1.7 Hz."""
    swayed, other = np.sin(2.0 * np.pi * 1.7 * times), np.sin(2.0 * np.pi * 0.9 * times + 1.0)
    centres = np.c_[0.8 * times, 0.02 * swayed, 0.02 * other]
    turns = Rotation.from_rotvec(np.c_[0.02 * other, 0.02 * swayed + 0.1 * times, 0.01 * swayed])
    return turns.as_matrix(), centres


def jerked(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The walk with a turn by 0.2 rad within 0.2 s, 3.1 s after its begin."""
    rotations, centres = walk(times)
    turn = Rotation.from_rotvec(np.c_[0.0 * times, 0.1 * np.tanh((times - 3.1) / 0.08), 0.0 * times])
    return turn.as_matrix() @ rotations, centres


def true_motions(path: Path, times: FloatArray) -> list[RowMotion]:
    """Of views at `times`, by differences."""
    motions = []
    for time in times:
        rotations, centres = path(time + TICK * np.array([-1.0, 0.0, 1.0]))
        poses = np.concatenate([rotations, -rotations @ centres[..., None]], axis=2)
        motions.append(RowMotion(READOUT, HEIGHT, *rates_of(poses[0], poses[1], poses[2], TICK)))
    return motions


def rows_at(path: Path, time: float, rng: np.random.Generator, stretch: float = 1.0, count: int = 500) -> ViewRows:
    """Rows of points 1.5 to 2.5 m ahead, whose read-out is `stretch` times READOUT, with the noise of features."""
    inside = rng.uniform([-1.2, -0.7, 1.5], [1.2, 0.7, 2.5], (count, 3))
    (rotation,), (centre,) = path(np.array([time]))
    points = inside @ rotation + centre
    rows = np.full(count, 0.5 * HEIGHT)
    for _ in range(6):
        moments = time + (rows / HEIGHT - 0.5) * READOUT * stretch
        rotations, centres = path(moments)
        x, y, z = np.einsum("nij,nj->in", rotations, points - centres)
        rows = np.clip(FOCAL * y / z + 0.5 * HEIGHT, 0.0, HEIGHT)
    rays = np.c_[x / z, y / z] + rng.normal(0.0, NOISE / FOCAL, (count, 2))
    times = (rows / HEIGHT - 0.5) * READOUT
    return ViewRows(inside, rays, times, np.array([FOCAL, FOCAL]), NOISE)


def by_spline(path: Path, times: FloatArray) -> list[RowMotion]:
    """What the poses alone tell."""
    rates = spline_rates([round(time * 1e9) for time in times], *path(times))
    return [RowMotion(READOUT, HEIGHT, *of_view) for of_view in zip(*rates, strict=True)]


def found_on(path: Path, times: FloatArray, seed: int = 1, stretch: float = 1.0) -> list[RowMotion]:
    """By poses and rows."""
    rng = np.random.default_rng(seed)
    rows = [rows_at(path, time, rng, stretch) for time in times]
    return smoothed(times, *path(times), by_spline(path, times), rows)[0]


def velocities(motions: list[RowMotion]) -> FloatArray:
    """(N, 6) angular and linear, the latter per 2 m, the depth of the scene."""
    return np.array([[*motion.angular, *motion.linear / 2.0] for motion in motions])


def spread(errors: NDArray[np.floating[Any]]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def test_poses_and_rows_together_tell_more_than_either() -> None:
    times = STEP * np.arange(50, dtype=np.float64)
    true = velocities(true_motions(walk, times))
    alone = velocities(by_spline(walk, times))
    rng = np.random.default_rng(1)
    rows = [rows_at(walk, time, rng) for time in times]
    # A walk whose views stand far apart in time has no trajectory: each follows its own rows.
    of_rows = velocities(smoothed(1e3 * times, *walk(times), by_spline(walk, times), rows)[0])
    together = velocities(found_on(walk, times))
    left = spread((together - true)[INNER])
    assert left < 0.5 * spread((alone - true)[INNER])
    assert left < 0.8 * spread((of_rows - true)[INNER])


def test_the_ends_are_told_by_their_rows() -> None:
    """There a spline knows nothing of what is beyond: it is off by up to 0.4 rad/s."""
    times = STEP * np.arange(20, dtype=np.float64)
    true, found, alone = (
        velocities(motions) for motions in (true_motions(walk, times), found_on(walk, times), by_spline(walk, times))
    )
    ends = [0, 1, -2, -1]
    assert spread((found - true)[ends]) < 0.02 < 0.2 * np.abs((alone - true)[ends]).max()


def test_accelerations_are_those_of_the_path() -> None:
    times = STEP * np.arange(40, dtype=np.float64)
    true, found = (
        np.array([motion.linear_acceleration for motion in motions])
        for motions in (true_motions(walk, times), found_on(walk, times))
    )
    # 0.2 m/s^2 moves first and last row of 30 ms by 0.02 mm.
    assert spread((found - true)[INNER]) < 0.2 < 0.25 * spread(true)
    # A camera that turns at 0.1 rad/s and walks at 0.8 m/s sees the model bend by 0.16 m/s^2.
    assert np.abs((found - true)[INNER].mean(axis=0)).max() < 0.05


def test_what_is_slow_is_told_by_the_poses() -> None:
    """Rows that were told another read-out tell other velocities, all of them alike."""
    times = STEP * np.arange(50, dtype=np.float64)
    true, found = velocities(true_motions(walk, times)), velocities(found_on(walk, times, stretch=1.02))
    assert abs((found - true)[INNER, 3].mean()) < 0.3 * 0.02 * 0.4  # of what the rows have wrong: 0.4 depths/s


def test_a_jerk_leaves_other_axes_and_other_views_alone() -> None:
    """The view beside it turns by 1 rad/s, of which the spline is off by half, and its neighbours by a tenth."""
    times = STEP * np.arange(32, dtype=np.float64)
    true = velocities(true_motions(jerked, times))
    errors = np.abs(velocities(found_on(jerked, times)) - true)
    assert np.abs(velocities(by_spline(jerked, times)) - true)[14:18, 1].max() > 0.2
    assert errors[14:18, 1].max() < 0.01
    assert errors[12:20, [0, 2, 3, 4, 5]].max() < 0.007


def coned(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A camera at rest whose axis goes round a cone of 0.15 rad once a second."""
    phase = 2.0 * np.pi * times
    turns = Rotation.from_rotvec(0.15 * np.c_[np.cos(phase), np.sin(phase), 0.0 * phase])
    return turns.as_matrix(), np.zeros((len(times), 3))


def test_turns_about_changing_axes_add_up() -> None:
    """The sum of the turns between views is not that of the velocity: about its own axis the camera turns, too."""
    times = STEP * np.arange(50, dtype=np.float64)
    true, found = velocities(true_motions(coned, times)), velocities(found_on(coned, times))
    assert abs((found - true)[INNER, 2].mean()) < 0.005


def test_a_view_without_rows_follows_its_neighbours() -> None:
    times = STEP * np.arange(30, dtype=np.float64)
    rng = np.random.default_rng(1)
    rows: list[ViewRows | None] = [rows_at(walk, time, rng) for time in times]
    rows[15] = None
    found, apart = smoothed(times, *walk(times), by_spline(walk, times), rows)
    true = true_motions(walk, times)
    assert np.abs(velocities(found) - velocities(true))[15].max() < 0.02
    assert (apart[15] == 0.0).all()
    assert (apart[:15] > 0.0).all()


def test_rows_that_contradict_the_motion_are_told() -> None:
    times = STEP * np.arange(32, dtype=np.float64)
    rng = np.random.default_rng(1)
    rows = [rows_at(jerked, time, rng) for time in times]
    apart = smoothed(times, *jerked(times), by_spline(jerked, times), rows)[1]
    assert apart[15, 1] > 20.0 > np.median(apart)


def test_one_row_tells_no_motion() -> None:
    """All features in one row, as of a band of texture: they tell a pose, and the poses tell the motion."""
    times = STEP * np.arange(20, dtype=np.float64)
    rng = np.random.default_rng(1)
    rows = [rows_at(walk, time, rng) for time in times]
    rows = [replace(each, times=np.full_like(each.times, 0.01)) for each in rows]
    found, differences = smoothed(times, *walk(times), true_motions(walk, times), rows)
    assert np.abs(velocities(found) - velocities(true_motions(walk, times)))[INNER].max() < 0.1
    assert np.isfinite(differences).all()


def test_a_walk_without_rows_stays() -> None:
    times = STEP * np.arange(5, dtype=np.float64)
    motions = by_spline(walk, times)
    assert smoothed(times, *walk(times), motions, [None] * 5)[0] == motions


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_views_are_told_by_their_rows(count: int) -> None:
    times = STEP * np.arange(count, dtype=np.float64)
    true, found = velocities(true_motions(walk, times)), velocities(found_on(walk, times))
    assert np.abs(found - true).max() < 0.1


@settings(deadline=None, max_examples=20)
@given(st.lists(st.floats(MIN_GAP, 1.0), min_size=4, max_size=12))
def test_uneven_gaps_are_as_good(gaps: list[float]) -> None:
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    true, found = velocities(true_motions(walk, times)), velocities(found_on(walk, times))
    assert np.abs(found - true).max() < 0.1


@settings(deadline=None, max_examples=20)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3),
    st.floats(0.05, 20.0),
)
def test_the_motions_do_not_depend_on_the_frame_or_unit_of_the_model(
    turn: list[float], moved: list[float], unit: float
) -> None:
    times = STEP * np.arange(12, dtype=np.float64)
    rotations, centres = walk(times)
    model_from_other = Rotation.from_rotvec(turn).as_matrix()
    rng = np.random.default_rng(1)
    rows = [rows_at(walk, time, rng) for time in times]
    others = [replace(each, inside=each.inside / unit) for each in rows]
    start = by_spline(walk, times)
    scaled = [
        replace(each, linear=each.linear / unit, linear_acceleration=each.linear_acceleration / unit) for each in start
    ]
    found, _ = smoothed(times, rotations, centres, start, rows)
    other, _ = smoothed(
        times, rotations @ model_from_other, (centres - moved) @ model_from_other / unit, scaled, others
    )
    for one, another in zip(found, other, strict=True):
        np.testing.assert_allclose(another.angular, one.angular, atol=1e-3)
        np.testing.assert_allclose(unit * another.linear, one.linear, atol=2e-3)
