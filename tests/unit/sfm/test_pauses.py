# SPDX-License-Identifier: Apache-2.0
"""A stream of keyframes that pauses: maps are made meanwhile, and the final map is that of one without pauses."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pytest
from filmed_wall import BOARDS, CONFIG, Lens, filmed

from pipeprog_camera.camera import Camera
from pipeprog_sfm.reconstruction import MetricMap, Reconstruction

LENS = Lens(330, 240, 247.0, 247.0, 164.5, 119.5)
PLACES = np.linspace(1.0, 2.0, 10).tolist()  # of the keyframes along x, m
Keyframes = list[tuple[int, bytes, Camera, str]]


@pytest.fixture(scope="module")
def keyframes() -> Keyframes:
    return filmed(PLACES, [LENS] * len(PLACES))


def maps(keyframes: Keyframes, pauses: Collection[int]) -> list[MetricMap]:
    """The maps made at pauses, which follow these keyframes, and the final one."""
    reconstruction = Reconstruction(CONFIG, BOARDS)
    made = []
    for number, keyframe in enumerate(keyframes):
        reconstruction.add(*keyframe)
        reconstruction.update_dense()
        if number in pauses:
            reconstruction.request_map(settled=True)
            while (metric_map := reconstruction.finished_map()) is None:
                pass
            made.append(metric_map)
    return [*made, reconstruction.finish()]


def test_the_final_map_does_not_depend_on_pauses(keyframes: Keyframes) -> None:
    (uninterrupted,) = maps(keyframes, pauses=())
    *early, final = maps(keyframes, pauses=(7, 8))
    assert all(len(each.cloud.points) for each in early)
    np.testing.assert_array_equal(final.trajectory.map_from_camera, uninterrupted.trajectory.map_from_camera)
    np.testing.assert_array_equal(final.cloud.points, uninterrupted.cloud.points)
