# SPDX-License-Identifier: Apache-2.0
"""Stands for any of the three nodes: the same topics and services, no computing. What goes wrong is said by FAKE."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos

FAULT = os.environ.get("FAKE", "")
WINDOW = 5


class FakeNode(Node):
    """Counts what it hears; `_work` is called for each input and `_end` when the survey is to finish."""

    def __init__(self) -> None:
        super().__init__("unnamed")
        self._role = self.get_name()
        self._inputs: list[int] = []
        self._outputs = 0
        self._finish: tuple[int, Future] | None = None
        self._infos = 0
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(0.2, self._report)
        self.create_service(srv.Finish, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup())
        {"frames": self._be_frames, "sfm": self._be_sfm, "detect": self._be_detect}[self._role]()
        if f"child of {self._role}" == FAULT:
            child = subprocess.Popen(["sleep", "300"])
            Path(os.environ["FAKE_FOLDER"], "pids").write_text(f"{os.getpid()} {child.pid}")

    def _report(self) -> None:
        self._diagnostics.publish(DiagnosticArray(status=[DiagnosticStatus(name=f"{self._role}: fake")]))

    def _be_frames(self) -> None:
        self._decisions = self.create_publisher(msg.FrameDecision, "frame_decisions", qos.reliable(1000))
        self._images = self.create_publisher(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._calibrations = self.create_publisher(CameraInfo, "keyframes/camera_info", qos.reliable(50))
        self.create_subscription(CameraInfo, "camera_info", self._count_info, qos.reliable(30))
        self.create_subscription(CompressedImage, "image/compressed", self._on_image, qos.reliable(30))
        self.create_subscription(Image, "image", self._on_image, qos.reliable(30))
        self.create_subscription(msg.ImageOverlapArray, "image_overlap", lambda _: None, qos.reliable(50))
        self._undecided: list[CompressedImage] = []

    def _be_sfm(self) -> None:
        self._overlaps = self.create_publisher(msg.ImageOverlapArray, "image_overlap", qos.kept(50))
        self._points = self.create_publisher(PointCloud2, "map_points", qos.latched())
        self._poses = self.create_publisher(PathMsg, "keyframe_poses", qos.latched())
        self._statuses = self.create_publisher(msg.SfmStatus, "sfm_status", qos.latched())
        self._status = msg.SfmStatus()
        self.create_subscription(CompressedImage, "keyframes/image/compressed", self._on_keyframe, qos.reliable(50))
        self.create_subscription(CameraInfo, "keyframes/camera_info", self._count_info, qos.reliable(50))

        self.create_subscription(Odometry, "odometry", self._on_motion, qos.reliable(1000))
        self.create_subscription(Imu, "imu", self._on_motion, qos.reliable(1000))
        self.create_subscription(TFMessage, "/tf_static", self._on_motion, qos.kept(1000))

    def _on_motion(self, message: Odometry | Imu | TFMessage) -> None:
        self._status.motion_considered += len(message.transforms) if isinstance(message, TFMessage) else 1
        self._statuses.publish(self._status)

    def _be_detect(self) -> None:
        self._pipes = self.create_publisher(msg.PipeArray, "pipes", qos.latched())
        self._markers = self.create_publisher(MarkerArray, "pipe_markers", qos.latched())
        self.create_subscription(CompressedImage, "keyframes/image/compressed", lambda _: None, qos.reliable(50))
        self.create_subscription(CameraInfo, "keyframes/camera_info", self._count_info, qos.reliable(50))
        self.create_subscription(PointCloud2, "map_points", self._on_map, qos.latched())
        self.create_subscription(PathMsg, "keyframe_poses", lambda _: None, qos.latched())
        self.create_subscription(msg.KeyframeVelocities, "keyframe_velocities", lambda _: None, qos.latched())
        self.create_subscription(msg.SfmStatus, "sfm_status", lambda _: None, qos.latched())

    def _count_info(self, _: CameraInfo) -> None:
        self._infos += 1

    def _on_image(self, message: CompressedImage | Image) -> None:
        if not self._inputs:
            Path(os.environ["FAKE_FOLDER"], "playing").touch()
        self._inputs.append(messages.stamp_ns(message.header.stamp))
        self._undecided.append(message)
        while self._images.get_subscription_count() < 2:  # as the real selector waits for those who listen
            time.sleep(0.02)
        if len(self._undecided) >= WINDOW:
            self._decide()
        if FAULT == "frames dies" and len(self._inputs) == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        if FAULT == "slow":
            time.sleep(0.02)
        self._try_finish()

    def _decide(self) -> None:
        for number, message in enumerate(self._undecided):
            chosen = number == 0 and isinstance(message, CompressedImage)
            self._decisions.publish(msg.FrameDecision(header=message.header, chosen=chosen, reason="fake", overlap=0.5))
            if chosen:
                self._images.publish(message)
                self._calibrations.publish(CameraInfo(header=message.header))
                self._outputs += 1
        self._undecided.clear()

    def _on_keyframe(self, message: CompressedImage) -> None:
        self._inputs.append(messages.stamp_ns(message.header.stamp))
        image = msg.ImageOverlap(stamp=message.header.stamp, registered=True, overlap=0.75)
        self._overlaps.publish(msg.ImageOverlapArray(header=message.header, images=[image]))
        self._try_finish()

    def _on_map(self, message: PointCloud2) -> None:
        self._inputs.append(1)
        pipe = msg.Pipe(id="p01", radius=0.0365, class_name="DN65", class_probability=0.9, points=7)
        pipe.end.z = 2.0
        progress = msg.ClassProgress(class_name="DN65", outer_radius=0.0365, planned_length=3.0, installed_length=2.0)
        scale = {"scale_source": "board", "scale_sigma": 0.0004}
        self._pipes.publish(
            msg.PipeArray(header=message.header, map_revision=1, pipes=[pipe], classes=[progress], **scale)
        )
        self._markers.publish(MarkerArray(markers=[Marker(header=message.header, action=Marker.DELETEALL)]))
        self._try_finish()

    async def _on_finish(self, request: srv.Finish.Request, response: srv.Finish.Response) -> srv.Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._try_finish()
        response.message = await done
        response.success = not response.message
        response.outputs = self._outputs
        return response

    def _try_finish(self) -> None:
        if self._finish is None or len(self._inputs) < self._finish[0]:
            return
        if f"{self._role} dies at the end" == FAULT:
            os.kill(os.getpid(), signal.SIGKILL)
        problem = ""
        if self._role == "frames":
            self._decide()
        elif self._role == "sfm":
            problem = "no board was seen: show it to the camera" if FAULT == "no scale" else self._publish_map()
        else:
            self._outputs = 1
        self._finish[1].set_result(problem)
        self._finish = None

    def _publish_map(self) -> str:
        stamps = np.array(self._inputs)
        header = messages.header(int(stamps[-1]), "map")
        points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
        self._points.publish(messages.point_cloud(header, points, colors=np.zeros((1000, 3), np.uint8)))
        self._poses.publish(messages.path(header, stamps, np.tile(np.eye(4), (len(stamps), 1, 1))))
        self._outputs = 1
        self._status.header, self._status.map_stamp = header, header.stamp
        self._status.keyframes_registered, self._status.map_revision, self._status.metric = len(stamps), 1, True
        self._statuses.publish(self._status)
        return ""


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(FakeNode())
