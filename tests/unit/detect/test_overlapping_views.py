# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a rolling shutter are measured in: every part of a wall stays in as many as overlap asks for."""

from __future__ import annotations

from itertools import pairwise
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RowVelocities
from pipeprog_camera.view_overlap import FOR_THE_MOTION
from pipeprog_detect import worker
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.overlapping_views import without_overlapping
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Pipe

CAMERA = Camera(640, 360, 460.0, 460.0, 319.5, 179.5)
DEPTH = 2.0  # m to the wall
SEEN = 640 / 460 * DEPTH  # m of the wall across an image
# A grid of points, 2 cm apart, on a wall that the camera walks along.
WALL = np.stack([*np.meshgrid(np.arange(-3.0, 13.0, 0.02), np.arange(-0.6, 0.6, 0.1)), np.full((12, 800), DEPTH)], -1)
POINTS = WALL.reshape(-1, 3)


def walk(places: list[float]) -> list[FloatArray]:
    """Poses, camera_from_map, of a camera before the wall at places along it [m]."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 3] = -np.array(places)
    return list(poses)


def kept(places: list[float]) -> list[int]:
    return without_overlapping([(pose, CAMERA) for pose in walk(places)], POINTS)


def test_every_other_view_of_a_slow_walk_is_left_out() -> None:
    """Neighbours are 0.06 of an image apart, those two further 0.12, three 0.18."""
    assert kept([0.06 * SEEN * number for number in range(11)]) == [0, 2, 4, 6, 8, 10]


def test_all_views_of_a_fast_walk_stay() -> None:
    """Neighbours are 0.1 of an image apart, those two further 0.2."""
    assert kept([0.1 * SEEN * number for number in range(11)]) == list(range(11))


@pytest.mark.parametrize(("is_rolling", "expected"), [(True, [0, 2, 4]), (False, [0, 1, 2, 3, 4])])
def test_the_worker_measures_in_these(is_rolling: bool, expected: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a global shutter in all."""
    encoded = cv2.imencode(".png", np.zeros((360, 640), np.uint8))[1].tobytes()
    poses = np.stack([np.linalg.inv(pose) for pose in walk([0.06 * SEEN * number for number in range(5)])])
    still = np.zeros((5, 3))
    velocities = RowVelocities(0.02, still, still, still, still) if is_rolling else None
    site = worker.Map(1, POINTS.astype(np.float32), None, np.arange(5), poses, final=True, velocities=velocities)
    measured: list[int] = []

    def detect(*arguments: Any, **_: object) -> list[Pipe]:
        measured.extend(view.stamp for view in arguments[3])
        return []

    monkeypatch.setattr(worker, "detect", detect)
    commands = [*(worker.Keyframe(stamp, encoded, CAMERA) for stamp in range(5)), site]
    connection = Mock(recv=Mock(side_effect=[*commands, EOFError]))
    boq = BillOfQuantities((PipeClass("DN65", 0.0365, 3.0, (0.0, 0.0, 1.0), 4e-4),))
    with pytest.raises(EOFError):
        worker.serve(connection, DetectConfig(), boq, [], {})
    assert measured == expected


def test_a_camera_that_stands_still_is_seen_twice() -> None:
    """When it came, and when it went on."""
    assert kept([0.0] * 20) == [0, 19]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_views_stay(count: int) -> None:
    assert kept([0.0] * count) == list(range(count))


def test_views_before_which_there_is_nothing_stay() -> None:
    """No share of no points can be told."""
    assert without_overlapping([(np.diag([1.0, -1.0, -1.0, 1.0]), CAMERA)] * 3, POINTS) == [0, 1, 2]


@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=25))
def test_neighbours_that_stay_overlap_by_enough_or_were_neighbours(steps: list[float]) -> None:
    """Whatever the walk: nothing between two that stay shows more than 1 - FOR_THE_MOTION beside them."""
    places = np.cumsum(steps) * SEEN / 4.0
    stay = kept(places.tolist())
    assert {0, len(places) - 1} <= set(stay)
    for first, second in pairwise(stay):
        apart = (places[second] - places[first]) / SEEN
        assert second == first + 1 or apart <= 1.0 - FOR_THE_MOTION + 0.02  # of a sample of points
