# SPDX-License-Identifier: Apache-2.0
"""A map whose survey has refined the camera waits for that camera, and is measured with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.node import MapInput
from pipeprog_node.received.images import ReceivedCamera
from pipeprog_node.received.maps import ReceivedCloud, ReceivedPoses, ReceivedStatus

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
REFINED = replace(CAMERA, fx=50.5, fy=50.5, distortion=(0.1, 0.0, 0.0, 0.0))
PARTS = (
    ReceivedPoses(7, np.empty(0, np.int64), np.empty((0, 4, 4))),
    ReceivedCloud(7, np.empty((0, 3), np.float32), None),
)


class Door:
    """The intake of a node, by which parts of maps come in."""

    def __init__(self) -> None:
        self.use: dict[str, Callable[[Any], None]] = {}

    def subscribe(self, kind: type, topic: str, convert: object, use: Callable[[Any], None], *_: object) -> None:
        self.use[topic] = use


def test_a_map_waits_for_its_refined_camera() -> None:
    door = Door()
    maps = MapInput(door, lambda: None)  # type: ignore[arg-type]
    door.use["sfm_status"](ReceivedStatus(7, 1, "board", 0.001, camera_refined=True))
    for part in PARTS:
        door.use["map_points"](part)
    assert maps.newest is None
    assert maps.revision == 0
    door.use["keyframes/refined_camera_info"](ReceivedCamera(6, "camera", REFINED))  # of an earlier map
    assert maps.newest is None
    door.use["keyframes/refined_camera_info"](ReceivedCamera(7, "camera", REFINED))
    assert maps.newest is not None
    assert maps.newest.camera is not None
    assert maps.newest.camera.camera == REFINED
    assert maps.revision == 1


def test_a_map_with_the_camera_as_it_came_waits_for_none() -> None:
    door = Door()
    maps = MapInput(door, lambda: None)  # type: ignore[arg-type]
    door.use["sfm_status"](ReceivedStatus(7, 1, "board", 0.001))
    for part in PARTS:
        door.use["map_points"](part)
    assert maps.newest is not None
    assert maps.newest.camera is None


def test_keyframes_are_undistorted_with_the_refined_camera() -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
    keyframes = Keyframes()
    keyframes.add(1, cv2.imencode(".png", image)[1].tobytes(), CAMERA)
    assert np.array_equal(keyframes.view(1, np.eye(4)).image, image)
    assert keyframes.replace_camera(REFINED)
    assert not keyframes.replace_camera(REFINED)
    view = keyframes.view(1, np.eye(4))
    assert view.camera == REFINED.pinhole()
    assert np.array_equal(view.image, REFINED.undistort_image(image))
