# SPDX-License-Identifier: Apache-2.0
"""A camera that switches its resolution half-way along a generated site: one map of the right shape and size."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import FusionConfig, MapperConfig, SfmConfig, StereoConfig
from pipeprog_sfm.reconstruction import MetricMap, Reconstruction

sys.path.insert(0, str(Path(__file__).parents[3] / "bags"))  # the generator is a command beside its package
from sitegen.render import Lens, build_scene, render
from sitegen.sensor import Sensor, develop
from sitegen.site import BOARD_CENTRES, BOARD_CIRCLE_RADIUS, CONCRETE, PLASTER, SCREED, Site

LARGE = Lens(420, 270, 322.0, 322.0, 209.5, 134.5)
SMALL = Lens(330, 240, 247.0, 247.0, 164.5, 119.5)  # another aspect, and no whole-numbered ratio
PLACES = np.linspace(1.0, 2.0, 10)  # of the keyframes along x, m
HALF = len(PLACES) // 2
STEP = 500_000_000  # ns between two keyframes
DISTANCE = 1.7  # m to the wall
CONFIG = SfmConfig(
    mapper=MapperConfig(max_features=1000), stereo=StereoConfig(max_pairs=2), fusion=FusionConfig(voxel=0.01)
)

Keyframe = tuple[int, bytes, Camera, str]


def world_from_camera(x: float) -> np.ndarray:
    pose = np.eye(4)
    turn = 0.15 * np.sin(3.0 * x)
    pose[:3, 0] = np.cos(turn), np.sin(turn), 0.0
    pose[:3, 1] = 0.0, 0.0, -1.0
    pose[:3, 2] = -np.sin(turn), np.cos(turn), 0.0
    pose[:3, 3] = x, -DISTANCE + 0.1 * np.sin(5.0 * x), 1.3 + 0.05 * np.cos(4.0 * x)
    return pose


@pytest.fixture(scope="module")
def keyframes() -> list[Keyframe]:
    """Stamp [ns], PNG, calibration and frame of views of a wall with boxes and a board, by LARGE and then by SMALL."""
    site = Site((0.05,))
    site.wall((1.5, 0.0, 1.3), (0, -1, 0), 6.0, 3.0, CONCRETE)
    site.wall((1.5, -1.0, 0.0), (0, 0, 1), 6.0, 4.0, SCREED)
    for number, x in enumerate((0.4, 1.0, 2.2, 2.7)):
        site.box((x, -0.15 - 0.05 * number, 0.4 + 0.1 * number), (x + 0.25, 0.0, 1.1), PLASTER)
    site.board((1.55, 0.0, 1.45), (0, -1, 0), np.random.default_rng(0))
    site.tube_lamp((0.5, -1.5, 2.8), (2.5, -1.5, 2.8), 4.0, 2)
    scene = build_scene(site.primitives, site.lamps, 0.4, seed=1)
    rng = np.random.default_rng(2)
    views = []
    for number, x in enumerate(PLACES):
        lens = LARGE if number < HALF else SMALL
        rows = np.broadcast_to(world_from_camera(float(x)), (lens.height, 4, 4))
        image = develop(render(scene, lens, rows, edge_bits=2), Sensor(), rng)
        camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        views.append((number * STEP, cv2.imencode(".png", image)[1].tobytes(), camera, "camera"))
    return views


def reconstructed(keyframes: Sequence[Keyframe], pauses: Collection[int] = ()) -> tuple[MetricMap, Reconstruction]:
    """The final map; after the keyframes of these numbers the stream pauses, so that maps are made meanwhile."""
    centres = np.c_[np.array(BOARD_CENTRES), np.zeros(len(BOARD_CENTRES))]
    reconstruction = Reconstruction(CONFIG, BoardFile((Board("A", BOARD_CIRCLE_RADIUS, centres),)))
    for number, keyframe in enumerate(keyframes):
        reconstruction.add(*keyframe)
        reconstruction.update_dense()
        if number in pauses:
            reconstruction.request_map(settled=True)
            while (early := reconstruction.finished_map()) is None:
                pass
            assert len(early.cloud.points)
    return reconstruction.finish(), reconstruction


@pytest.fixture(scope="module")
def switched(keyframes: list[Keyframe]) -> tuple[MetricMap, Reconstruction]:
    """The map of the wall, its first half seen by LARGE and its second half by SMALL."""
    return reconstructed(keyframes)


def test_the_final_map_does_not_depend_on_pauses(
    keyframes: list[Keyframe], switched: tuple[MetricMap, Reconstruction]
) -> None:
    paused, _ = reconstructed(keyframes, pauses=(7, 8))
    np.testing.assert_array_equal(paused.trajectory.map_from_camera, switched[0].trajectory.map_from_camera)
    np.testing.assert_array_equal(paused.cloud.points, switched[0].cloud.points)


def test_all_keyframes_are_in_one_map(switched: tuple[MetricMap, Reconstruction]) -> None:
    status = switched[1].status()
    assert (status.seen, status.registered, status.models) == (len(PLACES), len(PLACES), 1)


def test_the_way_has_its_true_length(switched: tuple[MetricMap, Reconstruction]) -> None:
    found = switched[0].trajectory.map_from_camera[:, :3, 3]
    true = np.array([world_from_camera(float(x))[:3, 3] for x in PLACES])
    for part in (slice(None), slice(0, HALF), slice(HALF, None)):
        lengths = [np.linalg.norm(np.diff(way[part], axis=0), axis=1).sum() for way in (found, true)]
        assert lengths[0] == pytest.approx(lengths[1], rel=0.005)


def test_the_board_is_measured_in_images_of_both_sizes(switched: tuple[MetricMap, Reconstruction]) -> None:
    views = np.array(switched[0].scale.views) // STEP
    assert (views < HALF).sum() >= 2
    assert (views >= HALF).sum() >= 2
    assert switched[0].scale.sigma < 0.005


def test_the_cloud_has_the_wall_where_it_is(switched: tuple[MetricMap, Reconstruction]) -> None:
    # The map's origin is the board's middle: x along the wall, y into it, z up.
    points = switched[0].cloud.points
    wall = points[(np.abs(points[:, 1]) < 0.05) & (points[:, 2] > -0.2)]
    for left, right in ((-1.0, -0.3), (0.3, 1.0)):
        part = wall[(wall[:, 0] > left) & (wall[:, 0] < right)]
        assert len(part) > 100
        assert np.median(part[:, 1]) == pytest.approx(0.012, abs=0.01)  # the board is 12 mm thick
