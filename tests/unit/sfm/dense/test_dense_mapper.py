# SPDX-License-Identifier: Apache-2.0
"""The dense mapper on a walk along a textured wall, in exact views."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest

from pipeprog_camera import view_overlap
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import FusionConfig, StereoConfig
from pipeprog_sfm.dense import dense_mapper
from pipeprog_sfm.dense.dense_mapper import GIVEN_UP, OUTDATED, STILL, DenseMapper, Registered
from pipeprog_sfm.types import EncodedImage

WIDTH, HEIGHT = 240, 160
CAMERA = Camera(WIDTH, HEIGHT, 220.0, 220.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
STEP = 16  # px between two views of the wall at a distance of 1 m
TEXTURE = cv2.resize(
    np.random.default_rng(0).integers(0, 256, (HEIGHT // 4, WIDTH), np.uint8),
    (4 * WIDTH, HEIGHT),
    interpolation=cv2.INTER_CUBIC,
)
X = np.random.default_rng(1).uniform([-0.5, -0.35], [3.5, 0.35], (4000, 2))
POINTS = np.c_[X, np.ones(len(X))]  # of the wall, in metres


def pose(place: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = -place * STEP / CAMERA.fx
    return matrix


def image(place: int) -> EncodedImage:
    view = np.ascontiguousarray(TEXTURE[:, place * STEP :][:, :WIDTH])
    return EncodedImage(cv2.imencode(".png", view)[1].tobytes(), CAMERA)


def seen(camera_from_world: np.ndarray) -> np.ndarray:
    inside = POINTS + camera_from_world[:3, 3]
    pixels = inside[:, :2] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    return POINTS[(pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)]


def walk(places: list[int]) -> tuple[DenseMapper, dict[int, np.ndarray], list[int]]:
    """The mapper after keyframes at these places, their poses, and the number of depth maps after each."""
    dense = DenseMapper(StereoConfig(), FusionConfig())
    poses: dict[int, np.ndarray] = {}
    images = {}
    counts = []
    for stamp, place in enumerate(places):
        poses[stamp], images[stamp] = pose(place), image(place)
        dense.update(Registered(poses, images, lambda other: seen(poses[other])), complete=False)
        counts.append(len(dense))
    dense.update(Registered(poses, images, lambda other: seen(poses[other])), complete=True)
    return dense, poses, [*counts, len(dense)]


def rolling_walk(count: int) -> DenseMapper:
    """The mapper after as many keyframes of a rolling shutter, 0.25 s apart: depth maps wait for 3 s."""
    dense = DenseMapper(StereoConfig(), FusionConfig())
    poses: dict[int, np.ndarray] = {}
    images = {}
    for place in range(count):
        stamp = 250_000_000 * place
        poses[stamp], images[stamp] = pose(place), image(place)
        keyframes = Registered(poses, images, lambda other: seen(poses[other]), dict.fromkeys(poses, STILL))
        dense.update(keyframes, complete=place + 1 == count)
    return dense


@pytest.fixture(scope="module")
def there() -> tuple[DenseMapper, dict[int, np.ndarray], list[int]]:
    return walk(list(range(12)))


def test_the_cloud_is_the_wall(there: tuple[DenseMapper, dict[int, np.ndarray], list[int]]) -> None:
    dense, poses, _ = there
    cloud = dense.fuse(poses, poses, 1.0, complete=True, anew=True).result()
    assert len(cloud.points) > 5000  # 1.1 m x 0.7 m are seen thrice, a pixel of the depth maps is 9 mm
    # 0.1 px of disparity at the baseline of two steps: 0.1 / 32 of the distance
    assert np.median(np.abs(cloud.points[:, 2] - 1.0)) < 0.003
    assert np.quantile(np.abs(cloud.points[:, 2] - 1.0), 0.95) < 0.01


def test_lengths_follow_the_scale_and_the_drift_of_the_unit(
    there: tuple[DenseMapper, dict[int, np.ndarray], list[int]],
) -> None:
    dense, poses, _ = there
    halved = {stamp: matrix.copy() for stamp, matrix in poses.items()}
    for matrix in halved.values():
        matrix[:3, 3] /= 2.0  # the model has shrunk since the depth maps were made
    cloud = dense.fuse(poses, halved, 2.0, complete=True, anew=True).result()
    assert np.median(np.abs(cloud.points[:, 2] - 1.0)) < 0.003


def test_a_cloud_is_made_anew_where_the_poses_have_moved_by_more_than_a_voxel(
    there: tuple[DenseMapper, dict[int, np.ndarray], list[int]],
) -> None:
    dense, poses, _ = there
    whole = dense.fuse(poses, poses, 1.0, complete=True, anew=True).result()
    same = dense.fuse(poses, poses, 1.0, complete=True, anew=False).result()
    np.testing.assert_array_equal(same.points, whole.points)
    moved = {stamp: matrix.copy() for stamp, matrix in poses.items()}
    for matrix in moved.values():
        matrix[2, 3] -= 0.1  # the cameras are 0.1 m farther on in the map, and so is what they see
    after = dense.fuse(moved, poses, 1.0, complete=True, anew=False).result()
    assert np.median(after.points[:, 2]) - np.median(whole.points[:, 2]) == pytest.approx(0.1, abs=0.002)


def test_a_cloud_is_made_anew_where_much_of_it_is_of_depth_maps_given_up() -> None:
    dense, poses, _ = walk([*range(24)])
    whole, count = dense.fuse(poses, poses, 1.0, complete=True, anew=True).result(), len(dense)
    kept = 0
    for stamp in range(20):
        del poses[stamp]
        dense.retire([stamp])
        after = dense.fuse(poses, poses, 1.0, complete=False, anew=False).result()
        if count - len(dense) > GIVEN_UP * len(dense):
            anew = dense.fuse(poses, poses, 1.0, complete=False, anew=True).result()
            np.testing.assert_array_equal(after.points, anew.points)
            assert 0 < len(anew.points) < len(whole.points)
            break
        np.testing.assert_array_equal(after.points, whole.points)
        kept += count > len(dense)
    else:
        pytest.fail("never made anew")
    assert kept


def test_what_is_seen_again_makes_no_more_depth_maps() -> None:
    there_and_back = [*range(8), *range(7, -1, -1)]
    _, _, counts = walk(2 * there_and_back)
    assert 3 <= counts[9] <= 8
    assert counts[-2] <= counts[9] + 1
    assert walk(3 * there_and_back)[2][-1] == counts[-1]


def test_the_ends_of_a_walk_are_seen_as_often_as_must_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    def width(places: list[int]) -> float:
        dense, poses, _ = walk(places)
        across = dense.fuse(poses, poses, 1.0, complete=True, anew=True).result().points[:, 0]
        return float(np.ptp(np.percentile(across, [0.5, 99.5])))

    settled = width([*range(8)])
    monkeypatch.setattr(dense_mapper, "MARGIN", 1.0)
    assert settled > width([*range(8)]) + STEP / CAMERA.fx


def test_depth_maps_stay_while_the_camera_changes_by_little() -> None:
    dense, _, _ = walk([0, 1, 2, 3])
    count = len(dense)
    dense.change_camera(0.6 * OUTDATED)
    assert len(dense) == count > 0
    dense.change_camera(0.6 * OUTDATED)  # together they move the image by too much
    assert len(dense) == 0


def test_only_the_depth_maps_of_an_earlier_camera_are_made_anew() -> None:
    places = list(range(0, 24, 2))  # too far apart to show the same
    poses, images = {place: pose(place) for place in places}, {place: image(place) for place in places}
    half = {place: poses[place] for place in places[:6]}
    dense = DenseMapper(StereoConfig(), FusionConfig())
    dense.update(Registered(half, images, lambda other: seen(half[other])), complete=False)
    early = len(dense)
    dense.change_camera(0.6 * OUTDATED)
    dense.update(Registered(poses, images, lambda other: seen(poses[other])), complete=True)
    whole = len(dense)
    dense.change_camera(0.6 * OUTDATED)
    assert len(dense) == whole - early > 0
    dense.update(Registered(poses, images, lambda other: seen(poses[other])), complete=True)
    assert len(dense) == whole
    cloud = dense.fuse(poses, poses, 1.0, complete=True, anew=True).result()
    assert np.median(np.abs(cloud.points[:, 2] - 1.0)) < 0.003


@pytest.mark.parametrize(
    ("is_rolling", "newest", "expected"), [(False, 2, 1), (True, 2, 0), (True, 3, 0), (True, 4, 1)]
)
def test_with_a_rolling_shutter_depth_maps_wait_for_the_frames_between(
    is_rolling: bool, newest: int, expected: int
) -> None:
    """Keyframes that are a second apart; those between would come up to three seconds later."""
    stamps = [number * 10**9 for number in range(newest + 1)]
    poses = {stamp: pose(4 * number) for number, stamp in enumerate(stamps)}
    images = {stamp: image(4 * number) for number, stamp in enumerate(stamps)}
    motions = dict.fromkeys(stamps, STILL) if is_rolling else {}
    keyframes = Registered(poses, images, lambda other: seen(poses[other]), motions)
    dense = DenseMapper(StereoConfig(), FusionConfig())
    dense.update(keyframes, complete=False)
    assert len(dense) == expected
    dense.update(keyframes, complete=True)
    assert len(dense) > expected


def test_with_a_rolling_shutter_margins_wait_for_the_keyframes_around() -> None:
    assert len(rolling_walk(24)) == len(walk(list(range(24)))[0])


def test_keyframes_that_came_for_the_motion_get_no_depth_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each shows the wall from another side, but those before and after it show the same of it."""
    monkeypatch.setattr(view_overlap, "SAME_SIDE", np.radians(3.0))  # a step turns the sights by 4 degrees
    ends = 8  # views that show a point of the wall's ends too seldom
    assert len(walk(list(range(24)))[0]) == 24
    assert len(rolling_walk(24)) <= 12 + ends // 2


def test_a_keyframe_that_came_for_the_motion_stands_in_for_those_retired() -> None:
    dense = rolling_walk(24)
    stamps = [250_000_000 * place for place in range(24)]
    retired = [stamps[10], stamps[12]]
    dense.retire(retired)
    before = len(dense)
    poses = {stamp: pose(place) for place, stamp in enumerate(stamps) if stamp not in retired}
    images = {stamp: image(place) for place, stamp in enumerate(stamps)}
    keyframes = Registered(poses, images, lambda other: seen(poses[other]), dict.fromkeys(poses, STILL))
    dense.update(keyframes, complete=True)
    assert len(dense) == before + 1


def test_a_retired_depth_map_is_made_again_from_a_neighbour() -> None:
    places = [place for place in range(8) for _ in range(2)]
    dense, poses, counts = walk(places)
    images = {stamp: image(place) for stamp, place in enumerate(places)}
    dense.retire([stamp for stamp in poses if stamp % 2 == 0])
    after = len(dense)
    assert after < counts[-1]
    left = {stamp: matrix for stamp, matrix in poses.items() if stamp % 2 == 1}
    dense.update(Registered(left, images, lambda other: seen(left[other])), complete=True)
    assert len(dense) > after
    assert len(dense.fuse(left, left, 1.0, complete=True, anew=True).result().points) > 1000


def test_a_depth_map_may_be_retired_while_a_cloud_of_it_is_awaited() -> None:
    dense, poses, _ = walk(list(range(12)))
    cloud = dense.fuse(poses, poses, 1.0, complete=True, anew=True)
    dense.retire([max(poses)])
    assert len(cloud.result().points) > 1000


def test_what_has_not_been_begun_is_given_up_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that ends would make all depth maps that wait first, each of which takes a second."""
    begun, may_end = threading.Semaphore(0), threading.Event()

    def made(*_: object) -> None:
        begun.release()
        may_end.wait()

    monkeypatch.setattr(DenseMapper, "_depth", made)
    dense, _, _ = walk([*range(24)])
    for _ in range(dense_mapper.THREADS):
        begun.acquire()
    assert len(dense) > dense_mapper.THREADS
    dense.close()
    may_end.set()
    assert sum(not future.cancelled() for future in dense._depths.values()) == dense_mapper.THREADS
