# SPDX-License-Identifier: Apache-2.0
"""A camera that switches its resolution half-way along a generated site: one map of the right shape and size."""

from __future__ import annotations

import numpy as np
import pytest
from filmed_wall import BOARDS, CONFIG, STEP, Lens, filmed, world_from_camera

from pipeprog_sfm.reconstruction import MetricMap, Reconstruction

LARGE = Lens(420, 270, 322.0, 322.0, 209.5, 134.5)
SMALL = Lens(330, 240, 247.0, 247.0, 164.5, 119.5)  # another aspect, and no whole-numbered ratio
PLACES = np.linspace(1.0, 2.0, 10).tolist()  # of the keyframes along x, m
HALF = len(PLACES) // 2


@pytest.fixture(scope="module")
def switched() -> tuple[MetricMap, Reconstruction]:
    """The map of the wall, its first half seen by LARGE and its second half by SMALL."""
    reconstruction = Reconstruction(CONFIG, BOARDS)
    for keyframe in filmed(PLACES, [LARGE] * HALF + [SMALL] * HALF):
        reconstruction.add(*keyframe)
        reconstruction.update_dense()
    return reconstruction.finish(), reconstruction


def test_all_keyframes_are_in_one_map(switched: tuple[MetricMap, Reconstruction]) -> None:
    status = switched[1].status()
    assert (status.seen, status.registered, status.models) == (len(PLACES), len(PLACES), 1)


def test_the_way_has_its_true_length(switched: tuple[MetricMap, Reconstruction]) -> None:
    found = switched[0].trajectory.map_from_camera[:, :3, 3]
    true = np.array([world_from_camera(x)[:3, 3] for x in PLACES])
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
