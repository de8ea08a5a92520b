# SPDX-License-Identifier: Apache-2.0
"""The reconstruction as a ROS 2 node: keyframes in; map points, poses and overlaps out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_camera.limits import (
    MAX_TRANSFORM_FRAMES,
    MAX_WAITING_MOTION,
)
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.camera_transforms import FRAME, CameraTransforms
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.finish import FinishService
from pipeprog_node.intake import Intake, InvalidMessageError
from pipeprog_node.keyframe_input import REFINED_CALIBRATION, KeyframeInput
from pipeprog_node.main import run
from pipeprog_node.parameters import declare, declare_fixed
from pipeprog_node.processes.cores import limit_cores
from pipeprog_node.processes.journal import Journal, journal_of
from pipeprog_node.processes.supervision import Supervision
from pipeprog_node.processes.worker import WorkerProcess
from pipeprog_node.received import motion as received_motion
from pipeprog_node.received.keyframes import ReceivedRetirement
from pipeprog_node.received.motion import ReceivedAcceleration, ReceivedTransform, ReceivedTransforms
from pipeprog_node.retirement_input import RetirementInput
from pipeprog_sfm.alignment.map_file import read_map
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.metric.transform_tree import Acceleration, RobotMotion, Transform
from pipeprog_sfm.reconstruction import MetricMap, Status, Trajectory
from pipeprog_sfm.sparse.overlap import OverlapReport
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

MAX_BACKLOG = 50  # commands that wait for the process; as deep as the keyframes' topic
STATUS_PERIOD = 0.2  # s, at most, from a message of motion to the status that counts it
WAKE_PERIOD = 1.0  # s between two looks whether a reconstruction that died too often is to be started again
MAX_MOTION = 1000  # messages of odometry, TF or IMU that wait for this process: a second and more of the fastest IMU


class MotionInput:
    """Subscribes to what a robot tells about its motion; `considered` counts messages, TF's by their transforms.

    A message that cannot be used counts, too: a replay waits for all of them.
    reliable: no message may be lost, as in a replay; live, drivers send best effort.
    ignored: transforms from this frame are no motion of the robot's: it is `map` where the node publishes them itself.
    """

    def __init__(self, intake: Intake, reliable: bool, ignored: str | None = None) -> None:
        self.considered = 0
        self._ignored = ignored
        self._intake = intake
        # Since the last keyframe; static transforms by their child, since the newest counts.
        self._moving: deque[Transform] = deque(maxlen=MAX_WAITING_MOTION)
        self._static: dict[str, Transform] = {}
        self._accelerations: deque[Acceleration] = deque(maxlen=MAX_WAITING_MOTION)
        self._frames: set[str] = set()
        source = qos.reliable(MAX_MOTION) if reliable else qos.sensor(MAX_MOTION)
        kept = qos.kept(MAX_MOTION)

        def odometry(message: Odometry) -> ReceivedTransform:
            self.considered += 1
            return received_motion.odometry(message)

        def imu(message: Imu) -> ReceivedAcceleration:
            self.considered += 1
            return received_motion.imu(message)

        def transforms(message: TFMessage) -> ReceivedTransforms:
            self.considered += len(message.transforms)
            return received_motion.transforms(message)

        intake.subscribe(Odometry, "odometry", odometry, self._on_odometry, source, qos.OVERRIDABLE)
        intake.subscribe(Imu, "imu", imu, self._on_imu, source, qos.OVERRIDABLE)
        for topic, profile in (("/tf", source), ("/tf_static", kept)):
            use = partial(self._on_transforms, topic)
            intake.subscribe(TFMessage, topic, transforms, use, profile, qos.OVERRIDABLE)

    def take(self) -> RobotMotion:
        """What has come since the last call."""
        motion = RobotMotion((*self._static.values(), *self._moving), tuple(self._accelerations))
        self._static.clear()
        self._moving.clear()
        self._accelerations.clear()
        return motion

    def _on_odometry(self, pose: ReceivedTransform) -> None:
        self._add("odometry", pose)

    def _on_transforms(self, topic: str, message: ReceivedTransforms) -> None:
        for error in message.refused:
            self._intake.reject(topic, error)
        for transform in message.transforms:
            if transform.parent != self._ignored:
                self._add(topic, transform)

    def _add(self, topic: str, edge: ReceivedTransform) -> None:
        if not self._knows(topic, edge.parent, edge.child):
            return
        static = topic == "/tf_static"
        transform = Transform(edge.stamp, edge.parent, edge.child, edge.parent_from_child, static)
        if static:
            self._static[edge.child] = transform
        else:
            self._moving.append(transform)

    def _on_imu(self, felt: ReceivedAcceleration) -> None:
        if felt.force is not None and self._knows("imu", felt.frame):
            self._accelerations.append(Acceleration(felt.stamp, felt.frame, felt.force))

    def _knows(self, topic: str, *frames: str) -> bool:
        """Whether the frames are among the first MAX_TRANSFORM_FRAMES; says where not."""
        if len(self._frames.union(frames)) > MAX_TRANSFORM_FRAMES:
            text = f"more than {MAX_TRANSFORM_FRAMES} names of frames: {frames[-1]!r} and further ones are left out"
            self._intake.reject(topic, InvalidMessageError("frames", text))
            return False
        self._frames.update(frames)
        return True


class MapOutput:
    """Publishes events of the reconstruction as messages.

    Attributes:
        revision: maps published.
        frame: where the map's origin is, in words; empty before the first map.
        newest_stamp: of the poses published last [ns].
        correction: distance [m] by which the last map moved the keyframe that it moved most.
    """

    def __init__(self, node: Node) -> None:
        self.revision = 0
        self.frame = ""
        self.correction = 0.0
        self._node = node
        self._logger = node.get_logger()
        self._map_stamp = self.newest_stamp = 0
        self._map_trajectory: Trajectory | None = None
        self._overlap = node.create_publisher(msg.ImageOverlapArray, "image_overlap", qos.kept(50))
        self._points = node.create_publisher(PointCloud2, "map_points", qos.latched())
        self._poses = node.create_publisher(PathMsg, "keyframe_poses", qos.latched())
        # With a rolling shutter only.
        self._velocities: Publisher[msg.KeyframeVelocities] | None = None
        self._statuses = node.create_publisher(msg.SfmStatus, "sfm_status", qos.latched())
        self._cameras = node.create_publisher(CameraInfo, REFINED_CALIBRATION, qos.latched())
        self._camera_refined = self._final = False

    def publish_overlap(
        self, header: Header, reports: Sequence[OverlapReport], keyframes: int, retired: int, readout: float
    ) -> None:
        """Overlap after so far considered `keyframes` and `retired` messages of retirement; read-out in use, s."""
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
                place_overlap=report.place_overlap,
            )
            for report in reports
        ]
        self._overlap.publish(
            msg.ImageOverlapArray(
                header=header,
                keyframes_considered=keyframes,
                retirements_considered=retired,
                images=images,
                readout=readout,
            )
        )

    def publish_poses(self, trajectory: Trajectory) -> Header:
        """Poses in `map`; returns the header under which they were published."""
        # Stamps of two publications differ by a nanosecond at least, so that cloud and poses of a map can be paired.
        self.newest_stamp = max(int(trajectory.stamps[-1]), self.newest_stamp + 1)
        header = messages.header(self.newest_stamp, "map")
        if trajectory.velocities is not None:
            if self._velocities is None:
                self._velocities = self._node.create_publisher(
                    msg.KeyframeVelocities, "keyframe_velocities", qos.latched()
                )
            each = trajectory.velocities
            rates = each.linear, each.angular, each.linear_acceleration, each.angular_acceleration
            self._velocities.publish(messages.keyframe_velocities(header, each.readout, *rates))
        self._poses.publish(messages.path(header, trajectory.stamps, trajectory.map_from_camera))
        return header

    def publish_map(self, metric_map: MetricMap, camera_frame: str, *, final: bool) -> None:
        """Poses and cloud of a new map, and the camera where it was refined, all under the same stamp."""
        self.revision += 1
        header = self.publish_poses(metric_map.trajectory)
        self._map_stamp, self._final = self.newest_stamp, final
        self._camera_refined = metric_map.refined_camera is not None
        if metric_map.refined_camera is not None:
            self._cameras.publish(messages.info_from_camera(metric_map.refined_camera, self._map_stamp, camera_frame))
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
        circles = scale.board_circles if scale else np.empty((0, 4))
        self._statuses.publish(
            msg.SfmStatus(
                header=messages.header(stamp, "map"),
                keyframes_seen=status.seen,
                keyframes_registered=status.registered,
                keyframes_waiting=status.waiting,
                models=status.models,
                map_revision=self.revision,
                map_stamp=messages.time_msg(self._map_stamp),
                map_final=self._final,
                reprojection_error=status.reprojection_error,
                metric=scale is not None,
                scale_source=scale.source if scale else "",
                scale_sigma=scale.sigma if scale else np.nan,
                motion_considered=motion_considered,
                camera_refined=self._camera_refined,
                calibration=status.calibration,
                readout=status.readout,
                readout_sigma=status.readout_sigma,
                board_circles=[Point(x=x, y=y, z=z) for x, y, z in circles[:, :3].tolist()],
                board_circle_radii=circles[:, 3].tolist(),
                message=status.message,
            )
        )


class SfmNode(Node):
    """Converts messages to commands of the reconstruction's process, and its events to messages."""

    def __init__(self, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("sfm", parameter_overrides=list(overrides))
        extra = ("board", "colmap", "lockstep", "intermediate", "publish_tf", "reference", "journal")
        config = declare(self, SfmConfig, extra=extra)
        limit_cores(config.cores, self.get_logger().warning)
        board = declare_fixed(self, "board", "", "file of the boards on site")
        intermediate = declare_fixed(
            self, "intermediate", True, "publish maps and poses while keyframes come, not the last alone"
        )
        reference = declare_fixed(self, "reference", "", "map.npz of the survey in whose frame the map is to lie")
        earlier = read_map(Path(reference)) if reference else None
        self._arguments = config, load_board_file(board) if board else BoardFile(), intermediate, earlier
        self._has_started = False  # a worker
        self._colmap = declare_fixed(self, "colmap", "", "folder for the sparse model, beside which map.npz goes")
        self._lockstep = declare_fixed(self, "lockstep", False, "every message counts, as in a replay")
        publish_tf = declare_fixed(self, "publish_tf", False, "publish map -> camera of the keyframes on /tf")
        self._transforms = CameraTransforms(self) if publish_tf else None
        journal = journal_of(declare_fixed(self, "journal", "", "folder for the journal of a survey"), "sfm")
        self._supervision = Supervision(self._start_worker, "the reconstruction process", journal=journal)
        self._done = self._dropped = self._retired = 0  # keyframes answered, keyframes left out, Retires answered
        self._output = MapOutput(self)
        self._intake = Intake(self)
        self._motion = MotionInput(self._intake, self._lockstep, ignored=FRAME if publish_tf else None)
        self._status = Status()
        self._motion_published = 0  # messages of motion that the last status counts
        self._retiring: deque[ReceivedRetirement] = deque()  # at the worker
        self._seen = self._last_stamp = 0
        self._camera_frame = ""  # of the newest keyframe
        self._finish_sent = False
        self._finishing_at = (0, 0)  # `_commands` when the last map was asked for
        self._finished_at: tuple[int, int] | None = None  # the same, once that map has been sent
        self._is_journalled = journal is not None
        known, retired = (None, None) if journal is None else self._take_up(journal)
        self._keyframes = KeyframeInput(self._intake, self._on_keyframe, known=known)
        self._retirements = RetirementInput(self._intake, self._retire, known=retired)
        self._retirements.keyframes_came(self._seen)
        self._finish = FinishService(self, lambda: self._seen, self._begin_finish)
        self._diagnostics = Diagnostics(self, "reconstruction", self._health)
        # Wall time: the status must follow while a paused recording stops ROS time.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._status_timer = self.create_timer(STATUS_PERIOD, self._publish_new_motion, clock=steady)
        self._waking = self.create_timer(WAKE_PERIOD, self._supervision.wake, clock=steady)

    def destroy_node(self) -> None:
        """Ends the worker with the node."""
        self._supervision.close()
        super().destroy_node()

    def _take_up(self, journal: Journal) -> tuple[list[int], list[tuple[int, ...]]]:
        """Counts what is in the journal as before; returns the stamps of the keyframes and retirements in it."""
        known, retired = [], []
        for number, command in journal.commands():
            is_answered = number not in journal.waiting
            if isinstance(command, AddKeyframe):
                known.append(command.stamp)
                self._done += is_answered
                self._camera_frame = command.frame
                continue
            retired.append(command.stamps)
            self._retired += is_answered
            if not is_answered:
                self._retiring.append(ReceivedRetirement(max(command.stamps), self._camera_frame, 0, command.stamps))
        if journal.note is not None:
            self._dropped, self._output.revision, self._output.newest_stamp = journal.note
        self._seen, self._last_stamp = len(known) + self._dropped, max(known, default=0)
        return known, retired

    def _note(self) -> None:
        """Keeps what the commands do not tell for a process that takes this one's place."""
        self._supervision.note((self._dropped, self._output.revision, self._output.newest_stamp))

    def _on_keyframe(self, stamp: int, encoded: bytes, camera: Camera, frame_id: str) -> None:
        self._seen += 1
        self._last_stamp = max(self._last_stamp, stamp)
        self._camera_frame = frame_id
        keyframe = AddKeyframe(stamp, encoded, camera, frame_id)
        if self._supervision.is_poison(keyframe):
            self._leave_out(keyframe)
        elif self._supervision.backlog >= MAX_BACKLOG:
            self._dropped += 1
            self._note()
        else:
            self._supervision.send(replace(keyframe, motion=self._motion.take()))
        self._retirements.keyframes_came(self._seen)
        self._finish_when_complete()

    def _retire(self, retirement: ReceivedRetirement) -> None:
        self._retiring.append(retirement)
        self._supervision.send(Retire(retirement.stamps))

    @property
    def _commands(self) -> tuple[int, int]:
        """Keyframes and retirements that have come."""
        return self._seen, self._retired + len(self._retiring)

    def _begin_finish(self) -> None:
        """A further request with no keyframe between is answered with the map of the one before.

        Its client may not have heard the answer; another map of the same keyframes would be measured anew.
        """
        if self._finish.is_due and self._finished_at == self._commands:
            self._finish.answer(self._output.revision)
            return
        self._finish_sent = False
        self._finish_when_complete()

    def _finish_when_complete(self) -> None:
        if self._finish.is_due and not self._finish_sent:
            self._finish_sent = True
            if self._supervision.problem:
                self._finish.answer(self._output.revision, self._supervision.problem)
            else:
                self._finishing_at = self._commands
                self._supervision.request(Finish(self._motion.take(), self._colmap))

    def _start_worker(self, answered: Iterable[AddKeyframe | Retire]) -> WorkerProcess:
        # Where one has died of an image, the next ones must tell of which.
        ahead, self._has_started = not self._has_started, True
        return WorkerProcess(self, serve, (*self._arguments, ahead, answered), self._on_event, self._on_death)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Ready):
            self._supervision.ready()
            # Answers may have been lost with a process before this one.
            if self._is_journalled and self._done:
                self._publish_overlap((), messages.header(self._last_stamp, self._camera_frame))
            return
        self._status = event.status
        if isinstance(event, KeyframeDone):
            self._supervision.answered()
            self._done += 1
            self._publish_overlap(event.overlaps, messages.header(event.stamp, event.frame))
            if event.trajectory is not None:
                self._output.publish_poses(event.trajectory)
                self._publish_transform(event.trajectory)
        elif isinstance(event, Retired):
            self._supervision.answered()
            self._end_retirement(event.overlaps)
        elif isinstance(event, MapReady):
            self._output.publish_map(event.map, self._camera_frame, final=event.final)
            self._note()
            self._publish_transform(event.map.trajectory)
        self._publish_status()
        if isinstance(event, Finished):
            self._supervision.fulfilled()
            self._finished_at = None if event.problem else self._finishing_at
            self._finish.answer(self._output.revision, event.problem)

    def _publish_transform(self, trajectory: Trajectory) -> None:
        if self._transforms:
            self._transforms.publish(trajectory.stamps, trajectory.map_from_camera, self._camera_frame)

    def _on_death(self, exit_code: int) -> None:
        death = self._supervision.restart(exit_code)
        if self._lockstep and self._supervision.problem:  # a replay would wait for ever
            self.get_logger().fatal(f"{death.report}: the map is lost")
            raise SystemExit(1)
        self.get_logger().error(death.report)
        if isinstance(death.dropped, AddKeyframe):
            self._leave_out(death.dropped)
        elif isinstance(death.dropped, Retire):
            self._end_retirement(())
        if death.failed is not None:
            self._finish.answer(self._output.revision, death.report)

    def _leave_out(self, keyframe: AddKeyframe) -> None:
        """Counts a keyframe of which the reconstruction dies as answered, so that nobody waits for it."""
        self._dropped += 1
        self._note()
        self._publish_overlap((), messages.header(keyframe.stamp, keyframe.frame))

    def _end_retirement(self, reports: Sequence[OverlapReport]) -> None:
        self._retired += 1
        retirement = self._retiring.popleft()
        self._keyframes.forget(retirement.stamps)
        self._publish_overlap(reports, messages.header(retirement.stamp, retirement.frame_id))

    def _publish_overlap(self, reports: Sequence[OverlapReport], header: Header) -> None:
        done = self._done + self._dropped
        self._output.publish_overlap(header, reports, done, self._retired, self._status.readout)

    def _publish_new_motion(self) -> None:
        if self._motion_published < self._motion.considered:
            self._publish_status()

    def _publish_status(self) -> None:
        self._motion_published = self._motion.considered
        self._output.publish_status(self._status, self._last_stamp, self._motion_published)

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        status, dropped = self._status, self._dropped
        values: dict[str, Any] = {"keyframes": self._seen, "waiting": self._supervision.backlog, "dropped": dropped}
        values |= {"motion": self._motion.considered} | self._intake.health() | self._supervision.health()
        if self._supervision.problem:
            return DiagnosticStatus.ERROR, self._supervision.problem, values
        refused = "messages that cannot be used were dropped: the values say of which kind" * bool(
            self._intake.rejected
        )
        level = DiagnosticStatus.WARN if refused else DiagnosticStatus.OK
        if status == Status():
            return level, refused or ("waiting for keyframes" if self._supervision.is_ready else "starting"), values
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
        return level, refused or "mapping", values


def main() -> None:
    """Entry point of sfm_node."""
    run(SfmNode, renewed=("board", "colmap", "reference", "journal"))


if __name__ == "__main__":
    main()
