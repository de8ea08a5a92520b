# SPDX-License-Identifier: Apache-2.0
"""The mapper on a synthetic room corner: points with random descriptors, seen on a walk along it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, STEP, blurred, centre, pose, position_errors, ring_pose, ring_view, view

from pipeprog_camera.camera import Camera
from pipeprog_camera.rig import unique_stamp
from pipeprog_sfm.config import MapperConfig, OdometryConfig
from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.retrieval import Retrieval
from pipeprog_sfm.features.sift import Features, root_sift
from pipeprog_sfm.metric.rig import rig_measurements
from pipeprog_sfm.metric.scale import Measurement
from pipeprog_sfm.metric.transform_tree import Transform, TransformTree
from pipeprog_sfm.sparse.mapper import Mapper

# [m] Of a point at 2 m, 0.3 px are 0.7 mm; 300 points that hold a camera leave 0.04 mm, which trading turn for shift
# and the drift along 3 m of wall multiply by ten: 0.4 mm, and room for the largest error of fifteen cameras.
POSITION_TOLERANCE = 1e-3
# [m] Half a per cent of the focal length opens the loop by 28 px, which are 55 mm at 4 m: a tenth of it may stay.
LOOP_TOLERANCE = 5.5e-3


def walk(xs: NDArray[Any], period: float | None = None, seed: int = 0) -> tuple[Mapper, dict[int, NDArray[Any]]]:
    mapper = Mapper(MapperConfig(), seed=seed)
    truth = {}
    for n, x in enumerate(xs):
        truth[n * STEP] = pose(x, 0.1 * np.sin(4 * x))
        mapper.add_features(n * STEP, view(truth[n * STEP], n, period), CAMERA)
    mapper.finish()
    return mapper, truth


@pytest.fixture(scope="module")
def straight() -> tuple[Mapper, dict[int, NDArray[Any]]]:
    return walk(np.arange(0, 3, 0.2))


def test_every_keyframe_is_registered_where_it_was(straight: tuple[Mapper, dict[int, NDArray[Any]]]) -> None:
    mapper, truth = straight
    poses = mapper.map.camera_from_model()
    assert list(poses) == sorted(truth)
    assert (len(mapper.map.keyframes), len(mapper.map.waiting), len(mapper.map.models)) == (len(truth), 0, 1)
    assert position_errors(poses, truth).max() < POSITION_TOLERANCE
    # A coordinate's noise of 0.3 px makes errors of 0.38 px on average.
    assert 0.25 < mapper.map.reprojection_error() < 0.45


def test_two_cameras_of_a_robot_with_calibrations_of_their_own_make_one_map() -> None:
    """At equal moments, a quarter of a metre apart, the second with half the pixels: the map is true to their mount."""
    mapper, truth, frames = Mapper(MapperConfig()), {}, {}
    half = CAMERA.scaled(0.5)
    mount = pose(0.0, 0.2) @ np.linalg.inv(pose(0.0))
    mount[:3, 3] = [-0.25, 0.0, 0.0]  # second_from_first
    for n, x in enumerate(np.arange(0, 1.4, 0.2)):
        first = pose(x)
        for number, (name, camera, place) in enumerate((("left", CAMERA, first), ("right", half, mount @ first))):
            stamp = unique_stamp(n * STEP, number)
            features = view(place, 2 * n + number)
            pixels = ((features.keypoints + 0.5) * (camera.width / CAMERA.width) - 0.5).astype(np.float32)
            truth[stamp], frames[stamp] = place, name
            mapper.add_features(stamp, replace(features, keypoints=pixels), camera, name)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    assert list(poses) == sorted(truth)
    assert position_errors(poses, truth).max() < 2 * POSITION_TOLERANCE  # twice the error of a pixel
    transforms = TransformTree()
    transforms.add(Transform(0, "left", name, np.linalg.inv(edge), True) for name, edge in (("right", mount),))
    (measured,) = rig_measurements(frames, transforms, poses, OdometryConfig())
    assert isinstance(measured, Measurement)
    true = np.linalg.norm(centre(truth[6 * STEP]) - centre(truth[0]))
    found = np.exp(measured.log_scale) * np.linalg.norm(centre(poses[6 * STEP]) - centre(poses[0]))
    assert found == pytest.approx(true, rel=4 * measured.sigma)


def test_overlap_is_reported_once_and_again_when_it_changes() -> None:
    mapper = Mapper(MapperConfig())
    for n in range(4):
        mapper.add_features(n * STEP, view(pose(0.2 * n), n), CAMERA)
    first = {report.stamp: report for report in mapper.map.overlap_reports()}
    assert sorted(first) == [0, STEP, 2 * STEP, 3 * STEP]
    assert all(
        report.registered and 0.3 < report.overlap <= 1.0 and 0 < report.cell_overlap <= 1.0
        for report in first.values()
    )
    assert first[0].matches_previous == 0
    assert first[0].matches_next == first[STEP].matches_previous > 100
    assert mapper.map.overlap_reports() == []
    mapper.add_features(4 * STEP, view(pose(0.8), 4), CAMERA)
    assert 3 * STEP in {report.stamp for report in mapper.map.overlap_reports()}


def test_the_same_keyframes_give_the_same_bytes() -> None:
    (first, _), (second, _) = walk(np.arange(0, 1.2, 0.2)), walk(np.arange(0, 1.2, 0.2))
    assert first.map.points_seen(STEP).tobytes() == second.map.points_seen(STEP).tobytes()
    for stamp, camera_from_model in first.map.camera_from_model().items():
        assert camera_from_model.tobytes() == second.map.camera_from_model()[stamp].tobytes()


def test_a_texture_that_repeats_misplaces_nothing() -> None:
    mapper, truth = walk(np.arange(0, 3, 0.2), period=0.7)
    poses = mapper.map.camera_from_model()
    assert len(poses) == len(truth)
    assert position_errors(poses, truth).max() < POSITION_TOLERANCE


def test_two_models_are_joined_when_the_camera_returns() -> None:
    away = np.r_[np.arange(0, 1.0, 0.2), np.arange(4.0, 5.0, 0.2)]
    mapper, _ = walk(away)
    assert len(mapper.map.models) == 2
    assert len(mapper.map.camera_from_model()) == 5
    mapper, truth = walk(np.r_[away, np.arange(4.6, 0.4, -0.2)])
    assert len(mapper.map.models) == 1
    poses = mapper.map.camera_from_model()
    assert len(poses) == len(truth)
    assert position_errors(poses, truth).max() < POSITION_TOLERANCE


def test_a_loop_is_closed_though_the_map_has_drifted() -> None:
    # Half a per cent of the focal length: after a turn of 360 degrees the view is off by 28 px.
    camera = Camera(1280, 720, 904.5, 904.5, 639.5, 359.5)
    mapper, truth = Mapper(MapperConfig()), {}
    step = np.radians(9.0)
    for n in range(44):
        truth[n * STEP] = ring_pose(n * step)
        mapper.add_features(n * STEP, ring_view(n * step, n), camera)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    assert list(poses) == sorted(truth)
    assert len(mapper.map.models) == 1
    assert position_errors(poses, truth).max() < LOOP_TOLERANCE
    relative = poses[0] @ np.linalg.inv(poses[40 * STEP])
    assert np.degrees(np.arccos((np.trace(relative[:3, :3]) - 1) / 2)) < 0.1, "the 41st looks where the first did"


def test_a_keyframe_of_elsewhere_waits_with_a_reason() -> None:
    mapper = Mapper(MapperConfig())
    for n in range(4):
        mapper.add_features(n * STEP, view(pose(0.2 * n), n), CAMERA)
    rng = np.random.default_rng(0)
    strange = Features(
        rng.uniform([0, 0], [1280, 720], (800, 2)).astype(np.float32),
        root_sift(rng.gamma(0.7, 1.0, (800, 128)).astype(np.float32)),
    )
    report = mapper.add_features(4 * STEP, strange, CAMERA)
    assert not report.registered
    assert "agree on a pose" in report.reason
    assert len(mapper.map.waiting) == 1
    assert mapper.add_features(5 * STEP, view(pose(1.0), 5), CAMERA).registered


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_keyframe_with_hardly_any_feature_waits(count: int) -> None:
    mapper = Mapper(MapperConfig())
    for n in range(3):
        full = view(pose(0.2 * n), n)
        few = Features(full.keypoints[:count], full.descriptors[:count])
        assert not mapper.add_features(n * STEP, few, CAMERA).registered
    mapper.finish()
    assert mapper.map.camera_from_model() == {}
    assert mapper.map.reprojection_error() == 0
    assert all(not report.registered and report.overlap == 0 for report in mapper.map.overlap_reports())


def test_turning_on_the_spot_starts_no_model() -> None:
    mapper = Mapper(MapperConfig())
    for n in range(5):
        assert not mapper.add_features(n * STEP, view(pose(0.0, 0.05 * n), n), CAMERA).registered
    assert len(mapper.map.models) == 0


def test_retired_keyframes_leave_the_map_and_the_others_stay() -> None:
    mapper, truth = walk(np.arange(0, 2, 0.1))
    retired = [n * STEP for n in range(1, 20, 2)]
    mapper.map.overlap_reports()
    mapper.retire([*retired, 99])
    left = {stamp: pose for stamp, pose in truth.items() if stamp not in retired}
    assert (len(mapper.map.keyframes), len(mapper.map.published), len(mapper.map.waiting)) == (len(left), len(left), 0)
    reported = mapper.map.overlap_reports()
    assert [report.stamp for report in reported] == sorted(left)
    # What the neighbours of old shared with those that left does not count any more.
    assert reported[0].matches_next == reported[1].matches_previous > 100
    assert mapper.add_features(20 * STEP, view(pose(2.0), 20), CAMERA).registered
    mapper.finish()
    poses = mapper.map.camera_from_model()
    assert list(poses) == [*sorted(left), 20 * STEP]
    assert position_errors(poses, {**left, 20 * STEP: pose(2.0)}).max() < POSITION_TOLERANCE


def test_a_model_whose_keyframes_are_retired_is_given_up() -> None:
    mapper = Mapper(MapperConfig())
    for n in range(3):
        mapper.add_features(n * STEP, view(pose(0.2 * n), n), CAMERA)
    mapper.retire([0, 2 * STEP])
    assert (len(mapper.map.keyframes), len(mapper.map.models), len(mapper.map.waiting)) == (1, 0, 1)
    assert mapper.add_features(3 * STEP, view(pose(0.6), 3), CAMERA).registered
    assert (len(mapper.map.models), len(mapper.map.published)) == (1, 2)


def test_a_keyframe_that_comes_again_is_neither_searched_nor_matched_anew() -> None:
    extracted, matched = [], []

    def counted_extract(gray: NDArray[np.uint8], camera: Camera, config: MapperConfig) -> Features:
        number = int(gray[0, 0])
        extracted.append(number)
        return view(pose(0.2 * number), number)

    def counted_match(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
        matched.append(len(a))
        return match(a, b)

    mapper = Mapper(MapperConfig(), extract_features=counted_extract, retrieval=Retrieval(counted_match))
    for n in range(6):
        mapper.add(n * STEP, np.full((2, 2), n, np.uint8), CAMERA)
    first = dict(mapper.map.camera_from_model())
    mapper.retire([3 * STEP])
    matches_before = len(matched)
    assert mapper.add(3 * STEP, np.full((2, 2), 3, np.uint8), CAMERA).registered
    assert extracted == [0, 1, 2, 3, 4, 5]
    # Its neighbour of before is known; the one that has come since is not.
    assert len(matched) - matches_before == 1
    np.testing.assert_allclose(centre(mapper.map.camera_from_model()[3 * STEP]), centre(first[3 * STEP]), atol=0.01)


def test_what_is_remembered_of_retired_keyframes_is_bounded() -> None:
    extracted = []

    def counted_extract(gray: NDArray[np.uint8], camera: Camera, config: MapperConfig) -> Features:
        extracted.append(int(gray[0, 0]))
        return view(pose(0.2 * extracted[-1]), extracted[-1])

    mapper = Mapper(MapperConfig(), extract_features=counted_extract, remembered=2)
    for n in range(5):
        mapper.add_features(n * STEP, view(pose(0.2 * n), n), CAMERA)
    mapper.retire([n * STEP for n in range(5)])
    for n in (3, 4):
        mapper.add(n * STEP, np.full((2, 2), n, np.uint8), CAMERA)
    assert extracted == []
    mapper.add(2 * STEP, np.full((2, 2), 2, np.uint8), CAMERA)
    assert extracted == [2]


@pytest.mark.parametrize("kept", [0, 600])
def test_features_that_fit_better_are_taken(kept: int) -> None:
    """600 features are enough for a pose, none are not; the sharper ones then hold the keyframe as any other."""
    mapper = Mapper(MapperConfig())
    truth = {n * STEP: pose(0.2 * n) for n in range(8)}
    for n, stamp in enumerate(truth):
        features = view(truth[stamp], n)
        mapper.add_features(stamp, blurred(features, kept) if n == 4 else features, CAMERA)
    assert (4 * STEP in mapper.map.camera_from_model()) == (kept > 0)
    assert mapper.replace_features(4 * STEP, view(truth[4 * STEP], 4))
    assert (len(mapper.map.published), len(mapper.map.waiting)) == (8, 0)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    assert list(poses) == list(truth)
    assert position_errors(poses, truth).max() < POSITION_TOLERANCE
    reports = {report.stamp: report for report in mapper.map.overlap_reports()}
    # As many matches as between two that were sharp from the first, but for the scatter of two counts.
    usual = reports[3 * STEP].matches_previous
    assert reports[4 * STEP].matches_next > usual - 3.0 * np.sqrt(2.0 * usual)


def test_features_that_fit_worse_change_nothing() -> None:
    mapper, truth = walk(np.arange(0, 1.6, 0.2))
    before = mapper.map.camera_from_model()
    assert not mapper.replace_features(4 * STEP, blurred(view(truth[4 * STEP], 4), 600))
    after = mapper.map.camera_from_model()
    assert all(after[stamp].tobytes() == before[stamp].tobytes() for stamp in before)
