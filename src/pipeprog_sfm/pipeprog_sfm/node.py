# SPDX-License-Identifier: Apache-2.0
"""The reconstruction as a ROS 2 node: keyframes in; map points, poses and overlaps out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header

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
from pipeprog_sfm.map_output import MapOutput
from pipeprog_sfm.motion_input import MotionInput
from pipeprog_sfm.reconstruction import Status
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
