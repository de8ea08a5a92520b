# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a map while its keyframes stay where they were, and decoded keyframes within bounds."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measurement_cache import MeasurementCache, Question
from tests.unit.detect.pipe_and_wall import PIPE

FAR = Cylinder(PIPE.start + 2.0, PIPE.end + 2.0, 0.04)


def shifted(views: list[View], by: float, which: int) -> list[View]:
    moved = views[which].camera_from_map.copy()
    moved[0, 3] += by
    return [*views[:which], dataclasses.replace(views[which], camera_from_map=moved), *views[which + 1 :]]


def asked(views: list[View]) -> MeasurementCache:
    memory = MeasurementCache()
    memory.next_map()
    assert memory.recall(Question.of(PIPE, True, [FAR], views)) == (False, None)
    memory.keep(Question.of(PIPE, True, [FAR], views), None)
    memory.next_map()
    return memory


def test_an_answer_stands_while_nothing_near_has_changed(pipe_views: list[View]) -> None:
    nearly = dataclasses.replace(PIPE, start=PIPE.start + 1e-3)
    assert asked(pipe_views).recall(Question.of(nearly, True, [], shifted(pipe_views, 1e-5, 0))) == (True, None)
    memory = asked(pipe_views)
    memory.recall(Question.of(PIPE, True, [], pipe_views))
    memory.next_map()
    assert memory.recall(Question.of(PIPE, True, [], pipe_views))[0]
    memory.next_map()
    memory.next_map()
    assert not memory.recall(Question.of(PIPE, True, [], pipe_views))[0]


def test_it_falls_with_a_pose_a_view_a_neighbour_or_the_candidate(pipe_views: list[View]) -> None:
    memory = asked(pipe_views)
    beside = Cylinder(PIPE.start + np.array([0.15, 0.0, 0.0]), PIPE.end + np.array([0.15, 0.0, 0.0]), 0.04)
    assert not memory.recall(Question.of(PIPE, True, [], shifted(pipe_views, 2e-3, 3)))[0]
    assert not memory.recall(Question.of(PIPE, True, [], pipe_views[1:]))[0]
    assert not memory.recall(Question.of(PIPE, True, [beside], pipe_views))[0]
    assert not memory.recall(Question.of(PIPE, False, [], pipe_views))[0]
    assert not memory.recall(Question.of(dataclasses.replace(PIPE, radius=0.044), True, [], pipe_views))[0]


def test_a_tenth_more_views_are_no_reason_to_measure_again(pipe_views: list[View]) -> None:
    views = [dataclasses.replace(view, stamp=10 * turn + view.stamp) for turn in range(3) for view in pipe_views]
    memory = asked(views[:20])
    assert memory.recall(Question.of(PIPE, True, [], views[:22]))[0]
    memory.next_map()
    assert not memory.recall(Question.of(PIPE, True, [], views[:23]))[0], "counted from the views it was measured in"
    assert not asked(views[:20]).recall(Question.of(PIPE, True, [], views[1:21]))[0]


def test_keyframes_are_decoded_once_within_memory() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    image = np.random.default_rng(1).integers(0, 255, (48, 64), np.uint8)
    encoded = cv2.imencode(".png", image)[1].tobytes()
    keyframes = Keyframes(most_bytes=2 * image.nbytes)
    for stamp in range(3):
        keyframes.add(stamp, encoded, camera)
    pose = np.eye(4)
    pose[0, 3] = 2.0
    first = keyframes.view(0, pose)
    np.testing.assert_array_equal(first.image, image)
    assert first.camera_from_map[0, 3] == -2.0
    assert keyframes.view(0, np.eye(4)).image is first.image
    keyframes.view(1, pose)
    keyframes.view(2, pose)
    assert keyframes.view(0, pose).image is not first.image
    assert 2 in keyframes
    assert 3 not in keyframes
    keyframes.add(4, b"no image", camera)
    with pytest.raises(InputError, match="keyframe at 4 ns"):
        keyframes.view(4, pose)
