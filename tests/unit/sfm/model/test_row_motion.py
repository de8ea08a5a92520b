# SPDX-License-Identifier: Apache-2.0
"""A walk along the synthetic corner through a rolling shutter."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, STEP, pose, position_errors, rates_of, view

from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.model.motion_smoothing import smoothed
from pipeprog_sfm.model.row_fit import ViewRows, fit_rows
from pipeprog_sfm.model.row_motion import row_motions, told_by_rows
from pipeprog_sfm.model.self_calibration import TOLERATED_SHIFT, Priors
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.mapper import Mapper
from pipeprog_sfm.sparse.registration import doubtful_views

READOUT = 0.03  # s
SPEED = 0.8  # m/s
TICK = 1e-4  # s of numerical derivatives
UNKNOWN = Priors(CAMERA, 0.0, np.array([0.003, 0.005, 0.01, 0.03]))


def camera_at(time: float) -> NDArray[np.float64]:
    """camera_from_world of a walk that sways at 0.4 Hz."""
    return pose(SPEED * time, 0.1 * np.sin(2.5 * time))


def started_fast(time: float) -> NDArray[np.float64]:
    """camera_from_world of the walk with another 0.5 m/s at first, which are gone within 0.12 s."""
    return pose(SPEED * time - 0.06 * np.exp(-time / 0.12), 0.1 * np.sin(2.5 * time))


def turned(time: float) -> NDArray[np.float64]:
    """camera_from_world of a walk that looks ahead by 0.25 rad from 3.1 s on, turning at up to 1.6 rad/s."""
    return pose(SPEED * time, 0.125 * np.tanh((time - 3.1) / 0.08))


def motion_at(time: float, path: Callable[[float], NDArray[np.float64]] = camera_at) -> RowMotion:
    """Velocities and accelerations of a path by differences."""
    poses = (path(time + step) for step in (-TICK, 0.0, TICK))
    return RowMotion(READOUT, CAMERA.height, *rates_of(*poses, TICK))


def walk(
    readout: float, path: Callable[[float], NDArray[np.float64]] = camera_at, count: int = 9
) -> tuple[Mapper, dict[int, NDArray[Any]]]:
    """What a mapper makes of images with a read-out of 30 ms, when it is told one."""
    mapper = Mapper(MapperConfig(), readout=readout)
    truth = {}
    for n in range(count):
        time = n * STEP * 1e-9
        truth[n * STEP] = path(time)
        mapper.add_features(n * STEP, view(truth[n * STEP], n, motion=motion_at(time, path)), CAMERA)
    mapper.finish()
    return mapper, truth


@pytest.fixture(scope="module")
def told() -> tuple[Mapper, dict[int, NDArray[Any]]]:
    return walk(READOUT)


def test_the_path_is_that_of_a_global_shutter(told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    mapper, truth = told
    poses = mapper.map.camera_from_model()
    assert list(poses) == sorted(truth)
    # As the same walk with a global shutter in test_mapper; ends of the walk are held by their own rows alone.
    assert position_errors(poses, truth).max() < 2e-3
    assert 0.25 < mapper.map.reprojection_error() < 0.45


def test_a_fast_start_leaves_no_error() -> None:
    """The spline is off by 0.5 m/s there: what its own rows tell was too little while points followed its error."""
    mapper, truth = walk(READOUT, started_fast)
    assert position_errors(mapper.map.camera_from_model(), truth).max() < 1e-3


def test_views_of_a_sudden_turn_follow_their_own_rows() -> None:
    """The spline is off by 0.3 rad/s there, and tells the views around another velocity."""
    mapper, truth = walk(READOUT, turned, count=32)
    model = mapper.map.published
    motions = mapper.map.motions(model)
    for number in (14, 15, 16, 17):
        stamp = number * STEP
        np.testing.assert_allclose(motions[stamp].angular, motion_at(stamp * 1e-9, turned).angular, atol=0.05)
    assert position_errors(mapper.map.camera_from_model(), truth).max() < 2e-3


@pytest.fixture(scope="module")
def told_long() -> tuple[Mapper, dict[int, NDArray[Any]]]:
    return walk(READOUT, count=40)


@pytest.mark.parametrize(
    ("factor", "grows_again", "final"), [(1.2, True, True), (0.95, False, True), (0.95, False, False)]
)
def test_a_read_out_that_was_off_leaves_no_trace(
    told_long: tuple[Mapper, dict[int, NDArray[Any]]], factor: float, grows_again: bool, final: bool
) -> None:
    """Turns in which rows correct the spline would leave the scene bent: shifts and poses agree with each other there.

    Beside a map that has been told: turns by the spline undo it.
    """
    told, truth = told_long
    mapper, _ = walk(factor * READOUT, count=40)
    found = mapper.self_calibration(UNKNOWN, final=True)
    assert found is not None
    # Of what it is off by, a quarter would stay if views whose rows decide on their velocity had a say.
    assert abs(found.readout - READOUT) < 0.15 * abs(factor - 1.0) * READOUT
    assert (found.shift > TOLERATED_SHIFT) == grows_again
    mapper.take_camera(replace(found, readout=READOUT), final)
    if final:
        mapper.finish()
    of_told, of_other = (
        float(np.sqrt((position_errors(each.map.camera_from_model(), truth) ** 2).mean())) for each in (told, mapper)
    )
    assert of_other < 1.1 * of_told


def test_few_points_tell_no_velocity(told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    """A view that has lost its points must not count among those whose rows contradict the spline."""
    mapper = told[0]
    keyframe, prior = mapper.map.keyframes[4 * STEP], mapper.map.motions(mapper.map.published)[4 * STEP]
    rows = ViewRows.of(np.ones((10, 3)), keyframe, np.arange(10), 0.3, prior)
    assert fit_rows(rows, prior, 0.2) is prior
    times, rest = np.array([0.0, 0.2]), np.tile(np.eye(3), (2, 1, 1))
    assert smoothed(times, rest, np.zeros((2, 3)), [prior, prior], [rows, None])[0] == [prior, prior]


def test_a_sway_between_two_poses_is_told() -> None:
    """1.7 Hz, by poses 0.2 s apart: a cubic spline would have its velocity a fifth too low."""
    model, keyframes = SparseModel(), {}
    rate = 2.0 * np.pi * 1.7
    for number in range(30):
        features = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
        keyframes[number * STEP] = Keyframe.of(number * STEP, features, CAMERA)
        camera_from_world = pose(0.0, 0.01 * np.sin(rate * 0.2 * number))
        camera_from_world[:3, 3] = 0.0
        model.add_view(number * STEP, np.zeros((0, 2)), np.array([900.0, 900.0]), camera_from_world)
    motions = row_motions(model, keyframes, READOUT).of_all()
    inner = range(6, 24)  # the condition at an end moves the sixth knot by 0.43^6, half a percent
    found = [motions[number * STEP].angular[1] for number in inner]
    true = [-0.01 * rate * np.cos(rate * 0.2 * number) for number in inner]
    np.testing.assert_allclose(found, true, atol=0.07 * 0.01 * rate)


def test_a_view_that_holds_far_fewer_points_than_those_around_it_is_registered_anew() -> None:
    """As one with a wrong velocity does: its features agree with a wrong pose alone."""
    mapper, truth = walk(READOUT)
    model = mapper.map.published
    assert doubtful_views(model, mapper.map.keyframes) == []
    view, stamp = 5, model.stamps[5]
    held = len(model.seen(view))
    first = model.offsets[view]
    tied = np.flatnonzero(model.point_of[model.features(view)] >= 0)
    model.point_of[first + tied[::2]] = -1
    assert doubtful_views(model, mapper.map.keyframes) == [view]
    mapper.finish()
    assert len(model.seen(model.stamps.index(stamp))) > 0.9 * held
    assert position_errors(mapper.map.camera_from_model(), truth).max() < 2e-3


@pytest.mark.parametrize(("views", "loose"), [(9, 2), (32, 7)])
def test_views_at_an_end_that_hang_on_by_few_points_are_registered_anew(views: int, loose: int) -> None:
    """As two do that were placed by each other: they share points with each other, and few with the rest."""
    mapper, truth = walk(READOUT, count=views)
    model = mapper.map.published
    first = [model.stamps.index(stamp) for stamp in sorted(truth)[:loose]]
    for end in first:
        own = model.offsets[end] + np.flatnonzero(model.point_of[model.features(end)] >= 0)
        model.point_of[own] += len(model.points)  # a copy of the points, which is theirs alone
    model.points = np.concatenate([model.points, model.points])
    model.translation[first] += 0.5
    assert doubtful_views(model, mapper.map.keyframes) == sorted(first)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    assert list(poses) == sorted(truth)
    assert position_errors(poses, truth).max() < 2e-3


def test_rows_of_matches_tell_how_a_new_view_moves(told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    model, keyframes = told[0].map.published, told[0].map.keyframes
    known = told[0].map.motions(model)
    off = np.array([0.1, -0.1, 0.1])  # rad/s
    for stamp in sorted(known)[2:-2]:
        number = model.stamps.index(stamp)
        points = model.point_of[model.features(number)]
        pairs = np.stack([np.flatnonzero(points >= 0), points[points >= 0]], axis=1)
        wrong = replace(known[stamp], angular=known[stamp].angular + off)
        others = copy.deepcopy(model)
        others.stamps[number] += STEP  # the keyframe is in the model here; the nearest to a new one is a step away
        found = told_by_rows(others, keyframes[stamp], model.pose(number), pairs, wrong)
        assert np.linalg.norm(found.angular - known[stamp].angular) < 0.25 * np.linalg.norm(off)


@pytest.fixture(scope="module")
def not_told() -> tuple[Mapper, dict[int, NDArray[Any]]]:
    return walk(0.0)


def test_without_the_readout_the_path_is_bent(not_told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    mapper, truth = not_told
    assert position_errors(mapper.map.camera_from_model(), truth).max() > 5e-3
    assert mapper.map.motions(mapper.map.published) == {}


def test_a_readout_that_is_not_told_is_found(not_told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    mapper, truth = copy.deepcopy(not_told)
    found = mapper.self_calibration(UNKNOWN, final=True)
    assert found is not None
    assert found.is_significant
    assert found.camera == CAMERA
    # Nine views of a sway whose spline knows the velocities to 3 %, those of the ends to 10 %.
    assert found.readout == pytest.approx(READOUT, rel=0.05)
    mapper.take_camera(found, final=True)
    assert mapper.map.readout == found.readout
    assert position_errors(mapper.map.camera_from_model(), truth).max() < 2e-3


def test_a_read_out_that_was_none_leaves_no_motion(told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    """However little it moves the features: they are as the images have them again."""
    mapper = copy.deepcopy(told[0])
    found = mapper.self_calibration(UNKNOWN, final=True)
    assert found is not None
    mapper.take_camera(replace(found, camera=CAMERA, readout=0.0, shift=0.5 * TOLERATED_SHIFT), final=True)
    assert mapper.map.motions(mapper.map.published) == {}


def test_a_global_shutter_stays_one() -> None:
    mapper = Mapper(MapperConfig())
    for n in range(7):
        mapper.add_features(n * STEP, view(camera_at(n * STEP * 1e-9), n), CAMERA)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    found = mapper.self_calibration(UNKNOWN, final=True)
    assert found is not None
    assert found.readout == 0.0
    assert found.readout_sigma < 0.001
    # What is not told leaves the bytes that a read-out of 0 has.
    after = mapper.map.camera_from_model()
    assert [pose.tobytes() for pose in after.values()] == [pose.tobytes() for pose in poses.values()]


def test_velocities_are_those_of_the_walk(told: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    mapper, truth = told
    poses, motions = mapper.map.camera_from_model(), mapper.map.motions(mapper.map.published)
    spread = [np.std([-p[:3, :3].T @ p[:3, 3] for p in each.values()], axis=0) for each in (truth, poses)]
    scale = np.linalg.norm(spread[0]) / np.linalg.norm(spread[1])
    for stamp in list(poses)[1:-1]:
        true = motion_at(stamp * 1e-9)
        # 0.02 m/s and rad/s move a pixel by 0.3 px within the 15 ms to the last row.
        np.testing.assert_allclose(scale * motions[stamp].linear, true.linear, atol=0.02)
        np.testing.assert_allclose(motions[stamp].angular, true.angular, atol=0.02)


def test_a_keyframe_that_comes_back_has_its_measured_features(
    told: tuple[Mapper, dict[int, NDArray[Any]]],
) -> None:
    keyframe = told[0].map.keyframes[5 * STEP]
    assert np.abs(keyframe.features.keypoints - keyframe.measured).max() > 1.0
    assert (keyframe.measured_features().keypoints == keyframe.measured).all()
