# SPDX-License-Identifier: Apache-2.0
"""A node of somebody else: publishes on every topic of the graph and on all that it discovers, and calls its services.

Half of the messages are empty, half well-formed and wrong. The file named as argument gets the names of the nodes that
it has found, a line each time that it looks.
"""

from __future__ import annotations

import importlib
import signal
import sys
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos

PERIOD = 0.1  # [s] between two messages on each topic
HEADER = Header(frame_id="map", stamp=messages.time_msg(1_700_000_000_000_000_000))
POSE = Pose(position=Point(x=9.0))
MESSAGES: dict[str, Any] = {
    "camera_info": CameraInfo(header=HEADER, width=64, height=48, distortion_model="plumb_bob"),
    "image": Image(header=HEADER, width=2, height=2, encoding="mono8", step=2, data=bytes(4)),
    "image/compressed": CompressedImage(header=HEADER, format="jpeg", data=b"no picture"),
    "keyframes/camera_info": CameraInfo(header=HEADER, width=64, height=48),
    "keyframes/image/compressed": CompressedImage(header=HEADER, format="jpeg", data=b"no picture"),
    "keyframes/retired": msg.KeyframesRetired(header=HEADER, keyframes_published=1, stamps=[HEADER.stamp]),
    "frame_decisions": msg.FrameDecision(header=HEADER, chosen=True, reason="foreign"),
    "image_overlap": msg.ImageOverlapArray(header=HEADER, keyframes_considered=1000),
    "map_points": PointCloud2(header=HEADER),
    "keyframe_poses": PathMsg(header=HEADER, poses=[PoseStamped(header=HEADER, pose=POSE)]),
    "sfm_status": msg.SfmStatus(map_revision=1000, message="foreign"),
    "pipes": msg.PipeArray(header=HEADER, map_revision=1000),
    "pipe_markers": MarkerArray(markers=[Marker(header=HEADER)]),
    "odometry": Odometry(header=HEADER),
    "imu": Imu(header=HEADER),
    "/tf": TFMessage(transforms=[TransformStamped(header=HEADER)]),
    "/tf_static": TFMessage(transforms=[TransformStamped(header=HEADER)]),
    "/diagnostics": DiagnosticArray(status=[DiagnosticStatus(name="sfm: foreign", level=DiagnosticStatus.ERROR)]),
}


class ForeignNode(Node):
    """Disturbs whatever it can reach, again and again."""

    def __init__(self, found: Path) -> None:
        super().__init__("foreign")
        self._found = found
        self._disturbances = [
            (self.create_publisher(type(wrong), topic, qos.kept(10)), wrong) for topic, wrong in MESSAGES.items()
        ]
        self._finishing = [self.create_client(srv.Finish, f"{name}/finish") for name in ("frames", "sfm", "detect")]
        self.create_timer(PERIOD, self._disturb)

    def _disturb(self) -> None:
        self._join_what_is_new()
        for publisher, wrong in self._disturbances:
            publisher.publish(wrong)
            publisher.publish(type(wrong)())
        for client in self._finishing:
            if client.service_is_ready():
                client.call_async(srv.Finish.Request())
        with self._found.open("a") as stream:
            stream.write(" ".join(name for name in self.get_node_names() if name != "foreign") + "\n")

    def _join_what_is_new(self) -> None:
        known = {publisher.topic_name for publisher, _ in self._disturbances}
        for topic, (first_type, *_) in self.get_topic_names_and_types():
            if topic not in known:
                package, _, name = first_type.split("/")
                kind = getattr(importlib.import_module(f"{package}.msg"), name)
                self._disturbances.append((self.create_publisher(kind, topic, qos.kept(10)), kind()))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    rclpy.init()
    rclpy.spin(ForeignNode(Path(sys.argv[1])))
