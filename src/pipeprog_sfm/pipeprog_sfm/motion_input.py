# SPDX-License-Identifier: Apache-2.0
"""Odometry, TF and IMU messages of the reconstruction's node, collected until the next keyframe."""

from __future__ import annotations

from functools import partial

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_node import messages, qos
from pipeprog_sfm.metric.transform_tree import Acceleration, RobotMotion, Transform

MAX_MOTION = 1000  # messages of odometry, TF or IMU that wait for this process: a second and more of the fastest IMU


class MotionInput:
    """Subscribes to what a robot tells about its motion; `considered` counts messages, TF's by their transforms.

    reliable: no message may be lost, as in a replay; live, drivers send best effort.
    """

    def __init__(self, node: Node, reliable: bool) -> None:
        self.considered = 0
        self._logger = node.get_logger()
        self._transforms: list[Transform] = []  # since the last keyframe, as are the accelerations
        self._accelerations: list[Acceleration] = []
        source = qos.reliable(MAX_MOTION) if reliable else qos.sensor(MAX_MOTION)
        subscribe = partial(node.create_subscription, qos_overriding_options=qos.OVERRIDABLE)
        subscribe(Odometry, "odometry", self._on_odometry, source)
        subscribe(Imu, "imu", self._on_imu, source)
        subscribe(TFMessage, "/tf", partial(self._on_transforms, static=False), source)
        subscribe(TFMessage, "/tf_static", partial(self._on_transforms, static=True), qos.kept(MAX_MOTION))

    def take(self) -> RobotMotion:
        """What has come since the last call."""
        motion = RobotMotion(tuple(self._transforms), tuple(self._accelerations))
        self._transforms, self._accelerations = [], []
        return motion

    def _on_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        self._add(message.header, message.child_frame_id, pose.position, pose.orientation, static=False)

    def _on_transforms(self, message: TFMessage, static: bool) -> None:
        for transform in message.transforms:
            edge = transform.transform
            self._add(transform.header, transform.child_frame_id, edge.translation, edge.rotation, static)

    def _add(
        self, header: Header, child: str, position: Point | Vector3, orientation: Quaternion, static: bool
    ) -> None:
        self.considered += 1
        x, y, z = position.x, position.y, position.z
        values = np.array([x, y, z, orientation.x, orientation.y, orientation.z, orientation.w])
        if not header.frame_id or not child or not np.isfinite(values).all() or not values[3:].any():
            self._logger.warning(
                f"a transform from '{header.frame_id}' to '{child}' cannot be used: it wants both names and a rotation",
                throttle_duration_sec=10.0,
            )
            return
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        # tf2 takes names with and without the leading slash of ROS 1 for the same.
        names = header.frame_id.lstrip("/"), child.lstrip("/")
        self._transforms.append(Transform(messages.stamp_ns(header.stamp), *names, pose, static))

    def _on_imu(self, message: Imu) -> None:
        self.considered += 1
        force = message.linear_acceleration
        values = np.array([force.x, force.y, force.z])
        # REP 145: -1 says that there are no accelerations.
        if message.linear_acceleration_covariance[0] >= 0 and np.isfinite(values).all():
            stamp = messages.stamp_ns(message.header.stamp)
            self._accelerations.append(Acceleration(stamp, message.header.frame_id.lstrip("/"), values))
