# SPDX-License-Identifier: Apache-2.0
"""Where the camera stands in `map`, on /tf: viewers then show its images and a robot's other sensors in the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from pipeprog_node import messages, qos

FRAME = "map"
DEPTH = 100  # as tf2's own broadcasters


class CameraTransforms:
    """Publishes the transform from `map` to the camera's optical frame, one for each keyframe, stamped as its image.

    A robot whose localisation owns the tree must not have it: a frame of tf2 has one parent.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(TFMessage, "/tf", qos.reliable(DEPTH))
        self._last = -1

    def publish(self, stamps: NDArray[np.int64], map_from_camera: NDArray[np.float64], camera_frame: str) -> None:
        """The place of the newest of (M,) stamps [ns], poses (M, 4, 4) [m]; once, as tf2 keeps a stamp's first."""
        newest = int(stamps.argmax())
        stamp = int(stamps[newest])
        if stamp <= self._last:
            return
        self._last = stamp
        moved = messages.transform(stamp, FRAME, camera_frame, map_from_camera[newest])
        self._publisher.publish(TFMessage(transforms=[moved]))
