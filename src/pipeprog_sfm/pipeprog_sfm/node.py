"""The reconstruction as a ROS 2 node: keyframes in; map points, poses and overlaps out."""

from __future__ import annotations

from collections import deque
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
from pipeprog_sfm.worker import AddKeyframe, Finish, Finished, KeyframeDone, MapReady, Ready, Retire, Retired, serve

MAX_BACKLOG = 50  # keyframes that wait for the worker; as deep as the topic's queue
MAX_VAIN_STARTS = 2  # of the worker that end before it has answered anything
STATUS_PERIOD = 0.2  # s, at most, from a message of motion to the status that counts it
MAX_MOTION = 1000  # samples of odometry, TF or IMU that wait for this process: seconds of the fastest


class SfmNode(Node):
    """Adapter around the worker process that holds the Reconstruction."""

    def __init__(self) -> None:
        super().__init__("sfm")
        config = declare(self, SfmConfig, extra=("board", "colmap", "lockstep"))
        board = str(self.declare_parameter("board", "").value)
        board_file = load_board_file(board) if board else BoardFile()
        self._colmap = str(self.declare_parameter("colmap", "").value)
        lockstep = bool(self.declare_parameter("lockstep", False).value)
        # A replay that loses its reconstruction ends; on the robot it is begun anew.
        self._journal = None if lockstep else Journal()
        self._answered = 0  # commands of the journal
        self._vain_starts = 0
        self._arguments = config, board_file
        self._worker = self._start_worker()
        self._images: dict[tuple[int, str], CompressedImage] = {}  # by stamp and frame, as the calibrations
        self._cameras: dict[tuple[int, str], Camera] = {}
        self._frame_ids: dict[int, str] = {}
        self._retirements: deque[msg.KeyframesRetired] = deque()  # to be applied after the keyframes before them
        self._retiring: deque[msg.KeyframesRetired] = deque()  # at the worker
        self._retired = 0
        self._seen = self._done = self._dropped = self._revision = 0
        self._last_stamp = self._map_stamp = self._pose_stamp = 0
        self._transforms: list[Transform] = []  # since the last keyframe, as are the accelerations
        self._accelerations: list[Acceleration] = []
        self._motion_considered = self._motion_told = 0  # messages of motion; told: in the last status
        self._map_frame = ""
        self._map_trajectory: Trajectory | None = None
        self._correction = 0.0  # of the last map: how far it has moved a keyframe, m
        self._ready = False
        self._status: Status | None = None
        self._finish: tuple[int, Future] | None = None
        self._finish_sent = False

        self._overlap = self.create_publisher(msg.ImageOverlapArray, "image_overlap", qos.kept(50))
        self._points = self.create_publisher(PointCloud2, "map_points", qos.latched())
        self._poses = self.create_publisher(Path, "keyframe_poses", qos.latched())
        self._statuses = self.create_publisher(msg.SfmStatus, "sfm_status", qos.latched())
        self.create_subscription(
            CompressedImage, "keyframes/image/compressed", self._on_image, qos.reliable(MAX_BACKLOG)
        )
        self.create_subscription(CameraInfo, "keyframes/camera_info", self._on_camera_info, qos.reliable(MAX_BACKLOG))
        self.create_subscription(msg.KeyframesRetired, "keyframes/retired", self._on_retired, qos.reliable(MAX_BACKLOG))
        # Live, drivers send best effort and a lost sample is none too many; a recording must lose none.
        source = qos.reliable(MAX_MOTION) if lockstep else qos.sensor(MAX_MOTION)
        subscribe = partial(self.create_subscription, qos_overriding_options=qos.OVERRIDABLE)
        subscribe(Odometry, "odometry", self._on_odometry, source)
        subscribe(Imu, "imu", self._on_imu, source)
        subscribe(TFMessage, "/tf", partial(self._on_transforms, static=False), source)
        subscribe(TFMessage, "/tf_static", partial(self._on_transforms, static=True), qos.kept(MAX_MOTION))
        # In a group of its own: while it waits for the end, the other callbacks must run.
        self.create_service(srv.Finish, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup())
        self._diagnostics = Diagnostics(self, "reconstruction", self._health)
        # Wall time: the status must follow while a paused recording stops ROS time.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._status_timer = self.create_timer(STATUS_PERIOD, self._tell_motion, clock=steady)

    def destroy_node(self) -> None:
        """Ends the worker with the node."""
        self._worker.close()
        if self._journal is not None:
            self._journal.close()
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
        """Hands a keyframe to the worker once image and calibration of one stamp are there."""
        if (stamp, frame_id) not in self._images or (stamp, frame_id) not in self._cameras:
            return
        image, camera = self._images.pop((stamp, frame_id)), self._cameras.pop((stamp, frame_id))
        # Cameras of one body may be triggered together: a nanosecond tells their images apart.
        while self._frame_ids.setdefault(stamp, frame_id) != frame_id:
            stamp += 1
        self._seen += 1
        self._last_stamp = max(self._last_stamp, stamp)
        if self._worker.backlog >= MAX_BACKLOG:
            self._dropped += 1
        else:
            self._send(AddKeyframe(stamp, bytes(image.data), camera, frame_id, self._take_motion()))
        self._retire_when_due()
        self._finish_when_complete()

    def _on_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        self._move(message.header, message.child_frame_id, pose.position, pose.orientation)

    def _on_transforms(self, message: TFMessage, static: bool) -> None:
        for transform in message.transforms:
            edge = transform.transform
            self._move(transform.header, transform.child_frame_id, edge.translation, edge.rotation, static)

    def _move(self, header: Header, child: str, place: Point | Vector3, turn: Quaternion, static: bool = False) -> None:
        self._motion_considered += 1
        values = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
        if not header.frame_id or not child or not np.isfinite(values).all() or not values[3:].any():
            self.get_logger().warning(
                f"a transform from '{header.frame_id}' to '{child}' cannot be used: it wants both names and a rotation",
                throttle_duration_sec=10.0,
            )
            return
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        stamp = messages.stamp_ns(header.stamp)
        # tf2 takes names with and without the leading slash of ROS 1 for the same.
        names = header.frame_id.lstrip("/"), child.lstrip("/")
        self._transforms.append(Transform(stamp, *names, pose, static))

    def _on_imu(self, message: Imu) -> None:
        self._motion_considered += 1
        force = message.linear_acceleration
        values = np.array([force.x, force.y, force.z])
        # REP 145: -1 says that there are no accelerations.
        if message.linear_acceleration_covariance[0] >= 0 and np.isfinite(values).all():
            stamp = messages.stamp_ns(message.header.stamp)
            self._accelerations.append(Acceleration(stamp, message.header.frame_id.lstrip("/"), values))

    def _take_motion(self) -> RobotMotion:
        motion = RobotMotion(tuple(self._transforms), tuple(self._accelerations))
        self._transforms, self._accelerations = [], []
        return motion

    def _on_retired(self, message: msg.KeyframesRetired) -> None:
        self._retirements.append(message)
        self._retire_when_due()

    def _retire_when_due(self) -> None:
        while self._retirements and self._seen >= self._retirements[0].keyframes_published:
            message = self._retirements.popleft()
            self._retiring.append(message)
            self._send(Retire(tuple(messages.stamp_ns(stamp) for stamp in message.stamps)))

    async def _on_finish(self, request: srv.Finish.Request, response: srv.Finish.Response) -> srv.Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._finish_sent = False
        self._finish_when_complete()
        problem = await done
        response.success = not problem
        response.message = problem
        response.outputs = self._revision
        return response

    def _finish_when_complete(self) -> None:
        if self._finish is not None and not self._finish_sent and self._seen >= self._finish[0]:
            self._finish_sent = True
            self._worker.send(Finish(self._take_motion(), self._colmap))

    def _on_event(self, event: Ready | KeyframeDone | Retired | MapReady | Finished) -> None:
        if isinstance(event, Ready):
            self._ready = True
            return
        self._status = event.status
        self._vain_starts = 0
        self._answered += isinstance(event, KeyframeDone | Retired)
        if isinstance(event, KeyframeDone):
            self._done += 1
            self._publish_overlap(messages.header(event.stamp, self._frame_ids[event.stamp]), event.overlaps)
            if event.trajectory is not None:
                self._publish_poses(event.trajectory)
        elif isinstance(event, Retired):
            self._retired += 1
            self._publish_overlap(self._retiring.popleft().header, event.overlaps)
        elif isinstance(event, MapReady):
            self._revision += 1
            self._publish_map(event.map)
        self._publish_status(event.status)
        if isinstance(event, Finished) and self._finish is not None:
            self._finish[1].set_result(event.problem)
            self._finish = None

    def _start_worker(self) -> WorkerProcess:
        done = () if self._journal is None else self._journal.record(0, self._answered)
        return WorkerProcess(self, serve, (*self._arguments, done), self._on_event, self._on_death)

    def _send(self, command: AddKeyframe | Retire) -> None:
        if self._journal is not None:
            self._journal.append(command)
        self._worker.send(command)

    def _on_death(self, exit_code: int) -> None:
        died = f"the reconstruction process died (exit code {exit_code})"
        self._vain_starts += 1
        if self._journal is None or self._vain_starts > MAX_VAIN_STARTS:
            self.get_logger().fatal(f"{died}: the map is lost")
            raise SystemExit(1)
        self.get_logger().error(f"{died}: it is started again, and takes its {self._answered} keyframes again")
        self._ready = False
        suspect = next(iter(self._journal.record(self._answered, self._answered + 1)), None)
        if isinstance(suspect, AddKeyframe):
            self._journal.remove(self._answered)
            self._dropped += 1
        self._worker = self._start_worker()
        for command in self._journal.record(self._answered, len(self._journal)):
            self._worker.send(command)
        if self._finish_sent:
            self._worker.send(Finish(self._take_motion(), self._colmap))

    def _publish_overlap(self, header: Header, reports: list[OverlapReport]) -> None:
        self._overlap.publish(
            msg.ImageOverlapArray(
                header=header,
                keyframes_considered=self._done + self._dropped,
                retirements_considered=self._retired,
                images=[
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
                ],
            )
        )

    def _publish_poses(self, trajectory: Trajectory) -> Header:
        # No two differ by less than a nanosecond, so that the cloud and the poses of one map find each other.
        self._pose_stamp = max(int(trajectory.stamps[-1]), self._pose_stamp + 1)
        header = messages.header(self._pose_stamp, "map")
        self._poses.publish(messages.path(header, trajectory.stamps, trajectory.map_from_camera))
        return header

    def _publish_map(self, metric_map: MetricMap) -> None:
        header = self._publish_poses(metric_map.trajectory)
        self._map_stamp = self._pose_stamp
        if metric_map.scale.frame != self._map_frame:
            self._map_frame = metric_map.scale.frame
            self.get_logger().info(f"frame map: {self._map_frame}")
        self._correction = metric_map.trajectory.correction(self._map_trajectory)
        self._map_trajectory = metric_map.trajectory
        cloud = metric_map.cloud
        self._points.publish(
            messages.point_cloud(header, cloud.points, colors=cloud.colors, normals=cloud.normals, views=cloud.views)
        )

    def _tell_motion(self) -> None:
        if self._motion_told < self._motion_considered:
            self._publish_status(self._status or Status())

    def _publish_status(self, status: Status) -> None:
        self._motion_told = self._motion_considered
        scale = status.scale
        self._statuses.publish(
            msg.SfmStatus(
                header=messages.header(self._last_stamp, "map"),
                keyframes_seen=status.seen,
                keyframes_registered=status.registered,
                keyframes_waiting=status.waiting,
                models=status.models,
                map_revision=self._revision,
                map_stamp=messages.time_msg(self._map_stamp),
                reprojection_error=status.reprojection_error,
                metric=scale is not None,
                scale_source=scale.source if scale else "",
                scale_sigma=scale.sigma if scale else np.nan,
                motion_considered=self._motion_considered,
                message=status.message,
            )
        )

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        status = self._status
        values: dict[str, Any] = {"keyframes": self._seen, "waiting": self._worker.backlog, "dropped": self._dropped}
        values |= {"motion": self._motion_considered}
        if status is None:
            return DiagnosticStatus.OK, "waiting for keyframes" if self._ready else "starting", values
        values |= {
            "registered": status.registered,
            "models": status.models,
            "reprojection error [px]": round(status.reprojection_error, 3),
            "map revision": self._revision,
            "map frame": self._map_frame,
            "map correction [m]": round(self._correction, 4),
        }
        if self._dropped or status.message:
            return DiagnosticStatus.WARN, status.message or "keyframes were dropped: the machine cannot keep up", values
        return DiagnosticStatus.OK, "mapping", values


def main() -> None:
    """Entry point of sfm_node."""
    run(SfmNode)


if __name__ == "__main__":
    main()
