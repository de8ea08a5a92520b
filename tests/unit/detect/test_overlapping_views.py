# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a rolling shutter are measured in: every part of a wall stays in as many as overlap asks for."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage, RowVelocities
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_detect import worker
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.overlapping_views import OVERLAP, without_overlapping
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Pipe, View

CAMERA = Camera(640, 360, 460.0, 460.0, 319.5, 179.5)
DEPTH = 2.0  # m to the wall
SEEN = 640 / 460 * DEPTH  # m of the wall across an image
# A grid of points, 2 cm apart, on a wall that the camera walks along.
WALL = np.stack([*np.meshgrid(np.arange(-3.0, 13.0, 0.02), np.arange(-0.6, 0.6, 0.1)), np.full((12, 800), DEPTH)], -1)
POINTS = WALL.reshape(-1, 3)
MOTION = RowMotion(0.02, 360, np.array([0.8, 0.0, 0.0]), np.zeros(3))


def walk(places: list[float], motion: RowMotion | None = MOTION) -> list[View]:
    """Views of the wall at places along it [m]."""
    views = []
    for stamp, place in enumerate(places):
        pose = np.eye(4)
        pose[0, 3] = -place
        rolled = None if motion is None else RolledImage(motion, CAMERA)
        views.append(View(stamp, np.zeros((360, 640), np.uint8), CAMERA, pose, rolled=rolled))
    return views


def stamps(views: list[View]) -> list[int]:
    return [view.stamp for view in without_overlapping(views, POINTS)]


def test_every_other_view_of_a_slow_walk_is_left_out() -> None:
    """Neighbours are 0.06 of an image apart, those two further 0.12, three 0.18."""
    views = walk([0.06 * SEEN * number for number in range(11)])
    assert stamps(views) == [0, 2, 4, 6, 8, 10]


def test_all_views_of_a_fast_walk_stay() -> None:
    """Neighbours are 0.1 of an image apart, those two further 0.2."""
    assert stamps(walk([0.1 * SEEN * number for number in range(11)])) == list(range(11))


def test_the_worker_measures_in_these(monkeypatch: pytest.MonkeyPatch) -> None:
    views = walk([0.06 * SEEN * number for number in range(5)])
    encoded = cv2.imencode(".png", views[0].image)[1].tobytes()
    poses = np.stack([np.linalg.inv(view.camera_from_map) for view in views])
    still = np.zeros((5, 3))
    velocities = RowVelocities(0.02, still, still, still, still)
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
    assert measured == [0, 2, 4]


def test_a_camera_that_stands_still_is_seen_twice() -> None:
    """When it came, and when it went on."""
    assert stamps(walk([0.0] * 20)) == [0, 19]


def test_of_a_global_shutter_all_stay_in_their_order() -> None:
    views = walk([0.02 * SEEN * number for number in range(6)], motion=None)[::-1]
    assert stamps(views) == [5, 4, 3, 2, 1, 0]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_views_stay(count: int) -> None:
    assert stamps(walk([0.0] * count)) == list(range(count))


def test_views_before_which_there_is_nothing_stay() -> None:
    """No share of no points can be told."""
    views = walk([0.0, 0.0, 0.0])
    turned = [replace(view, camera_from_map=np.diag([1.0, -1.0, -1.0, 1.0])) for view in views]
    assert [view.stamp for view in without_overlapping(turned, POINTS)] == [0, 1, 2]


@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=25))
def test_neighbours_that_stay_overlap_by_enough_or_were_neighbours(steps: list[float]) -> None:
    """Whatever the walk: nothing between two that stay shows more than 1 - OVERLAP beside them."""
    places = np.cumsum(steps) * SEEN / 4.0
    kept = stamps(walk(places.tolist()))
    assert {0, len(places) - 1} <= set(kept)
    for first, second in pairwise(kept):
        apart = (places[second] - places[first]) / SEEN
        assert second == first + 1 or apart <= 1.0 - OVERLAP + 0.02  # of a sample of points
