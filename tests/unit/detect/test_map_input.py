# SPDX-License-Identifier: Apache-2.0
"""Parts of maps come in; a map waits for those that belong to it, and replaces the maps before it."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pipeprog_camera.camera import Camera
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


def test_a_complete_map_replaces_those_before_it() -> None:
    door = Door()
    maps = MapInput(door, lambda: None)  # type: ignore[arg-type]
    clouds = []
    for revision in (1, 2, 3):
        cloud = ReceivedCloud(revision, np.ones((5, 3), np.float32), None)
        clouds.append(weakref.ref(cloud))
        door.use["map_points"](cloud)
        del cloud
        if revision < 3:  # the status of the third has not come yet
            door.use["keyframe_poses"](ReceivedPoses(revision, np.empty(0, np.int64), np.empty((0, 4, 4))))
            door.use["sfm_status"](ReceivedStatus(revision, revision, "board", 0.001))
    gc.collect()
    assert [cloud() is not None for cloud in clouds] == [False, True, True]
    assert maps.newest is not None
    assert maps.newest.status.revision == maps.revision == 2
    door.use["keyframe_poses"](ReceivedPoses(1, np.empty(0, np.int64), np.empty((0, 4, 4))))  # too late
    assert maps.newest.status.revision == 2
