# SPDX-License-Identifier: Apache-2.0
"""The reconstruction as a ROS 2 node: keyframes in; map points, poses and overlaps out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry, Path
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.main import run
from pipeprog_node.parameters import declare
from pipeprog_node.worker import WorkerProcess
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.journal import Journal
from pipeprog_sfm.metric.transform_tree import Acceleration, RobotMotion, Transform
from pipeprog_sfm.reconstruction import MetricMap, Status, Trajectory
from pipeprog_sfm.sparse.overlap import OverlapReport
from pipeprog_sfm.supervisor import MAX_BACKLOG, ReconstructionLostError, Supervisor
from pipeprog_sfm.worker import (
    AddKeyframe,
    Event,
    Finish,
    Finished,
    KeyframeDone,
    MapReady,
    Ready,
    Retire,
    Retired,
    serve,
)

STATUS_PERIOD = 0.2  # s, at most, from a message of motion to the status that counts it
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


class SfmNode(Node):
    """Converts messages to commands of the reconstruction's process, and its events to messages."""

    def __init__(self) -> None:
        super().__init__("sfm")
        config = declare(self, SfmConfig, extra=("board", "colmap", "lockstep"))
        board = str(self.declare_parameter("board", "").value)
        self._arguments = config, load_board_file(board) if board else BoardFile()
        self._colmap = str(self.declare_parameter("colmap", "").value)
        lockstep = bool(self.declare_parameter("lockstep", False).value)
        # A replay that loses its reconstruction ends; on the robot it is begun anew.
        self._supervisor = Supervisor(self._start_worker, None if lockstep else Journal())
        self._output = MapOutput(self)
        self._motion = MotionInput(self, reliable=lockstep)
        self._status = Status()
        self._motion_published = 0  # messages of motion that the last status counts
        self._images: dict[tuple[int, str], CompressedImage] = {}  # by stamp and frame, as the calibrations
        self._cameras: dict[tuple[int, str], Camera] = {}
        self._frame_ids: dict[int, str] = {}
        self._retirements: deque[msg.KeyframesRetired] = deque()  # to be applied after the keyframes before them
        self._retiring: deque[msg.KeyframesRetired] = deque()  # at the worker
        self._seen = self._last_stamp = 0
        self._finish: tuple[int, Future] | None = None
        self._finish_sent = False
        depth = qos.reliable(MAX_BACKLOG)
        self.create_subscription(CompressedImage, "keyframes/image/compressed", self._on_image, depth)
        self.create_subscription(CameraInfo, "keyframes/camera_info", self._on_camera_info, depth)
        self.create_subscription(msg.KeyframesRetired, "keyframes/retired", self._on_retired, depth)
        # In a group of its own: while it waits for the end, the other callbacks must run.
        self.create_service(srv.Finish, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup())
        self._diagnostics = Diagnostics(self, "reconstruction", self._health)
        # Wall time: the status must follow while a paused recording stops ROS time.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._status_timer = self.create_timer(STATUS_PERIOD, self._publish_new_motion, clock=steady)

    def destroy_node(self) -> None:
        """Ends the worker with the node."""
        self._supervisor.close()
        super().destroy_node()

    def _on_image(self, message: CompressedImage) -> None:
        stamp, frame_id = messages.stamp_ns(message.header.stamp), message.header.frame_id
        self._images[stamp, frame_id] = message
        self._pair(stamp, frame_id)

    def _on_camera_info(self, message: CameraInfo) -> None:
        stamp, frame_id = messages.stamp_ns(message.header.stamp), message.header.frame_id
        try:
            self._cameras[stamp, frame_id] = messages.camera_from_info(message)
        except InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        self._pair(stamp, frame_id)

    def _pair(self, stamp: int, frame_id: str) -> None:
        """Hands a keyframe to the worker once image and calibration of one stamp have both come."""
        if (stamp, frame_id) not in self._images or (stamp, frame_id) not in self._cameras:
            return
        image, camera = self._images.pop((stamp, frame_id)), self._cameras.pop((stamp, frame_id))
        # Cameras of one body may be triggered together: a nanosecond tells their images apart.
        while self._frame_ids.setdefault(stamp, frame_id) != frame_id:
            stamp += 1
        self._seen += 1
        self._last_stamp = max(self._last_stamp, stamp)
        if self._supervisor.is_full:
            self._supervisor.dropped += 1
        else:
            self._supervisor.send(AddKeyframe(stamp, bytes(image.data), camera, frame_id, self._motion.take()))
        self._retire_when_due()
        self._finish_when_complete()

    def _on_retired(self, message: msg.KeyframesRetired) -> None:
        self._retirements.append(message)
        self._retire_when_due()

    def _retire_when_due(self) -> None:
        while self._retirements and self._seen >= self._retirements[0].keyframes_published:
            message = self._retirements.popleft()
            self._retiring.append(message)
            self._supervisor.send(Retire(tuple(messages.stamp_ns(stamp) for stamp in message.stamps)))

    async def _on_finish(self, request: srv.Finish.Request, response: srv.Finish.Response) -> srv.Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._finish_sent = False
        self._finish_when_complete()
        problem = await done
        response.success = not problem
        response.message = problem
        response.outputs = self._output.revision
        return response

    def _finish_when_complete(self) -> None:
        if self._finish is not None and not self._finish_sent and self._seen >= self._finish[0]:
            self._finish_sent = True
            self._supervisor.finish(Finish(self._motion.take(), self._colmap))

    def _start_worker(self, answered: Iterable[AddKeyframe | Retire]) -> WorkerProcess:
        return WorkerProcess(self, serve, (*self._arguments, answered), self._on_event, self._on_death)

    def _on_event(self, event: Event) -> None:
        self._supervisor.note(event)
        if isinstance(event, Ready):
            return
        self._status = event.status
        if isinstance(event, KeyframeDone):
            self._publish_overlap(event, messages.header(event.stamp, self._frame_ids[event.stamp]))
            if event.trajectory is not None:
                self._output.publish_poses(event.trajectory)
        elif isinstance(event, Retired):
            self._publish_overlap(event, self._retiring.popleft().header)
        elif isinstance(event, MapReady):
            self._output.publish_map(event.map)
        self._publish_status()
        if isinstance(event, Finished) and self._finish is not None:
            self._finish[1].set_result(event.problem)
            self._finish = None

    def _on_death(self, exit_code: int) -> None:
        try:
            self.get_logger().error(self._supervisor.restart(exit_code))
        except ReconstructionLostError as error:
            self.get_logger().fatal(str(error))
            raise SystemExit(1) from None

    def _publish_overlap(self, event: KeyframeDone | Retired, header: Header) -> None:
        keyframes, retired = self._supervisor.done + self._supervisor.dropped, self._supervisor.retired
        self._output.publish_overlap(header, event.overlaps, keyframes, retired)

    def _publish_new_motion(self) -> None:
        if self._motion_published < self._motion.considered:
            self._publish_status()

    def _publish_status(self) -> None:
        self._motion_published = self._motion.considered
        self._output.publish_status(self._status, self._last_stamp, self._motion_published)

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        status, dropped = self._status, self._supervisor.dropped
        values: dict[str, Any] = {"keyframes": self._seen, "waiting": self._supervisor.backlog, "dropped": dropped}
        values |= {"motion": self._motion.considered}
        if status == Status():
            return DiagnosticStatus.OK, "waiting for keyframes" if self._supervisor.ready else "starting", values
        values |= {
            "registered": status.registered,
            "models": status.models,
            "reprojection error [px]": round(status.reprojection_error, 3),
            "map revision": self._output.revision,
            "map frame": self._output.frame,
            "map correction [m]": round(self._output.correction, 4),
        }
        if dropped or status.message:
            return DiagnosticStatus.WARN, status.message or "keyframes were dropped: the machine cannot keep up", values
        return DiagnosticStatus.OK, "mapping", values


def main() -> None:
    """Entry point of sfm_node."""
    run(SfmNode)


if __name__ == "__main__":
    main()
