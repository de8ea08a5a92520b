# SPDX-License-Identifier: Apache-2.0
"""What the reconstruction's node publishes: overlap, poses, map and status."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_sfm.reconstruction import MetricMap, Status, Trajectory
from pipeprog_sfm.sparse.overlap import OverlapReport


class MapOutput:
    """Publishes events of the reconstruction as messages.

    Attributes:
        revision: maps published.
        frame: where the map's origin is, in words; empty before the first map.
        correction: distance [m] by which the last map moved the keyframe that it moved most.
    """

    def __init__(self, node: Node) -> None:
        self.revision = 0
        self.frame = ""
        self.correction = 0.0
        self._logger = node.get_logger()
        self._map_stamp = self._pose_stamp = 0
        self._map_trajectory: Trajectory | None = None
        self._overlap = node.create_publisher(msg.ImageOverlapArray, "image_overlap", qos.kept(50))
        self._points = node.create_publisher(PointCloud2, "map_points", qos.latched())
        self._poses = node.create_publisher(Path, "keyframe_poses", qos.latched())
        self._statuses = node.create_publisher(msg.SfmStatus, "sfm_status", qos.latched())

    def publish_overlap(self, header: Header, reports: Sequence[OverlapReport], keyframes: int, retired: int) -> None:
        """Overlap after so far considered `keyframes` and `retired` messages of retirement."""
        images = [
            msg.ImageOverlap(
                stamp=messages.time_msg(report.stamp),
                registered=report.registered,
                overlap=report.overlap,
                cell_overlap=report.cell_overlap,
                tie_points=report.tie_points,
                features=report.features,
                matches_previous=report.matches_previous,
                matches_next=report.matches_next,
            )
            for report in reports
        ]
        self._overlap.publish(
            msg.ImageOverlapArray(
                header=header, keyframes_considered=keyframes, retirements_considered=retired, images=images
            )
        )

    def publish_poses(self, trajectory: Trajectory) -> Header:
        """Poses in `map`; returns the header under which they were published."""
        # Stamps of two publications differ by a nanosecond at least, so that cloud and poses of a map can be paired.
        self._pose_stamp = max(int(trajectory.stamps[-1]), self._pose_stamp + 1)
        header = messages.header(self._pose_stamp, "map")
        self._poses.publish(messages.path(header, trajectory.stamps, trajectory.map_from_camera))
        return header

    def publish_map(self, metric_map: MetricMap) -> None:
        """Poses and cloud of a new map, both under the same stamp."""
        self.revision += 1
        header = self.publish_poses(metric_map.trajectory)
        self._map_stamp = self._pose_stamp
        if metric_map.scale.frame != self.frame:
            self.frame = metric_map.scale.frame
            self._logger.info(f"frame map: {self.frame}")
        self.correction = metric_map.trajectory.correction(self._map_trajectory)
        self._map_trajectory = metric_map.trajectory
        cloud = metric_map.cloud
        self._points.publish(
            messages.point_cloud(header, cloud.points, colors=cloud.colors, normals=cloud.normals, views=cloud.views)
        )

    def publish_status(self, status: Status, stamp: int, motion_considered: int) -> None:
        """Health; stamp [ns]: of the newest keyframe."""
        scale = status.scale
        self._statuses.publish(
            msg.SfmStatus(
                header=messages.header(stamp, "map"),
                keyframes_seen=status.seen,
                keyframes_registered=status.registered,
                keyframes_waiting=status.waiting,
                models=status.models,
                map_revision=self.revision,
                map_stamp=messages.time_msg(self._map_stamp),
                reprojection_error=status.reprojection_error,
                metric=scale is not None,
                scale_source=scale.source if scale else "",
                scale_sigma=scale.sigma if scale else np.nan,
                motion_considered=motion_considered,
                message=status.message,
            )
        )
