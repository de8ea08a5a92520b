# SPDX-License-Identifier: Apache-2.0
"""The newest map whose pipes are there, while poses of keyframes and further maps go on coming."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from visualization_msgs.msg import MarkerArray

from pipeprog_bringup.playback.listener import LastMessages
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.keyframe_input import REFINED_CALIBRATION
from pipeprog_node.received import maps as received_maps

# Maps that wait for their pipes: one is measured, one waits, and the next replaces it. Poses come after each keyframe.
_CLOUDS, _POSES = 3, 100


class MapListener:
    """Subscribes to maps and pipes, which belong together where they have one stamp.

    Attributes:
        newest: cloud, poses, pipes, markers and velocities of one map; None before the first.
        poses: the last poses; None before the first.
    """

    def __init__(self, node: Node) -> None:
        self.newest: LastMessages | None = None
        self.poses: Path | None = None
        self._clouds: OrderedDict[int, PointCloud2] = OrderedDict()
        self._poses: OrderedDict[int, Path] = OrderedDict()
        self._velocities: OrderedDict[int, msg.KeyframeVelocities] = OrderedDict()
        self._pipes: msg.PipeArray | None = None
        self._markers: MarkerArray | None = None
        self._refined: CameraInfo | None = None
        node.create_subscription(PointCloud2, "map_points", self._on_cloud, qos.latched())
        node.create_subscription(Path, "keyframe_poses", self._on_poses, qos.latched())
        node.create_subscription(msg.KeyframeVelocities, "keyframe_velocities", self._on_velocities, qos.latched())
        node.create_subscription(msg.PipeArray, "pipes", self._on_pipes, qos.latched())
        node.create_subscription(MarkerArray, "pipe_markers", self._on_markers, qos.latched())
        node.create_subscription(CameraInfo, REFINED_CALIBRATION, self._on_refined, qos.latched())

    @property
    def revision(self) -> int:
        """Number of the newest map; 0 before the first."""
        return 0 if self.newest is None else int(self.newest.pipes.map_revision)

    def _on_cloud(self, message: PointCloud2) -> None:
        _keep(self._clouds, message, _CLOUDS)
        self._join()

    def _on_poses(self, message: Path) -> None:
        self.poses = message
        _keep(self._poses, message, _POSES)
        self._join()

    def _on_velocities(self, message: msg.KeyframeVelocities) -> None:
        try:
            received_maps.keyframe_velocities(message)
        except InvalidMessageError:  # of another node: the outlines are then those of the stamp
            return
        _keep(self._velocities, message, _POSES)
        self._join()

    def _on_pipes(self, message: msg.PipeArray) -> None:
        self._pipes = message
        self._join()

    def _on_markers(self, message: MarkerArray) -> None:
        self._markers = message
        self._join()

    def _on_refined(self, message: CameraInfo) -> None:
        self._refined = message
        self._join()

    def _join(self) -> None:
        if self._pipes is None or self._markers is None:
            return
        stamp = messages.stamp_ns(self._pipes.header.stamp)
        if messages.stamp_ns(self._markers.markers[0].header.stamp) != stamp:
            return
        if stamp in self._clouds and stamp in self._poses:
            parts = self._clouds[stamp], self._poses[stamp], self._pipes, self._markers
            self.newest = LastMessages(*parts, self._refined, self._velocities.get(stamp))
            for kept in (self._clouds, self._poses, self._velocities):
                for old in [each for each in kept if each < stamp]:
                    del kept[old]


def _keep(parts: OrderedDict[int, Any], message: Any, most: int) -> None:
    parts[messages.stamp_ns(message.header.stamp)] = message
    while len(parts) > most:
        parts.popitem(last=False)
