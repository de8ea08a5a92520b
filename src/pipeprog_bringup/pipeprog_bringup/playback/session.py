"""One passage of a recording through the running nodes: every frame in, the last messages out."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.node_processes import Graph, NodeFailure
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import TF, TF_STATIC, Bag, Frame, Motion
from pipeprog_bringup.results import result_files
from pipeprog_camera.errors import InputError
from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos

IN_FLIGHT = 8  # frames that the selector may not have decided on yet; above its window, or it would wait for ever
START_SECONDS = 90.0  # until all nodes have found each other: imports of a cold disk included
SILENCE_SECONDS = 60.0  # a node whose diagnostics (1 Hz) stay away that long hangs
# Between two decisions lie a few keyframes at most; the slowest machine works one off in less.
STANDSTILL_SECONDS = 300.0
DELIVERY_SECONDS = 60.0  # for the last messages, once the node has said that they are published
MIN_KEYFRAMES = 3  # fewer make no map worth the name
_MOVING = ("choosing keyframes", "working off the last keyframes")  # stages in which decisions and feedback arrive
IMAGE_TYPES = {cdr.COMPRESSED_IMAGE: (CompressedImage, "image/compressed"), cdr.IMAGE: (Image, "image")}
MOTION_TYPES = {"odometry": Odometry, "imu": Imu, TF: TFMessage, TF_STATIC: TFMessage}
KEPT = 1000  # messages of motion, more than are ever on their way
MOTION_IN_FLIGHT = 100  # messages of motion between two waits for the SfM to have them
# Subscribers of each topic within the graph, the command itself included, before the first image is worth sending.
_SUBSCRIBERS = {
    "keyframes/image/compressed": 2,
    "keyframes/camera_info": 2,
    "image_overlap": 2,
    "map_points": 1,
    "keyframe_poses": 1,
    "sfm_status": 2,
    "frame_decisions": 1,
}
_LATCHED = {
    PointCloud2: "map_points",
    PathMsg: "keyframe_poses",
    msg.PipeArray: "pipes",
    MarkerArray: "pipe_markers",
}


@dataclasses.dataclass(frozen=True)
class State:
    """Where a replay stands, for the progress display."""

    stage: str
    frames: int
    considered: int
    keyframes: int
    registered: int


@dataclasses.dataclass(frozen=True)
class LastMessages:
    """The last messages of the graph, all of one map."""

    cloud: PointCloud2
    poses: PathMsg
    pipes: msg.PipeArray
    markers: MarkerArray


class Passage:
    """One passage of a recording through the graph, at `rate` times real time or, with None, as fast as it goes."""

    def __init__(self, bag: Bag, rate: float | None, report: Callable[[State], None]) -> None:
        self._bag, self._rate, self._report = bag, rate, report
        self.log = FrameLog()
        self.timings: dict[str, float] = {}
        self._stage = ""
        self._status = msg.SfmStatus()
        self._heard: dict[str, float] = {}
        self._latest: dict[type, Any] = {}
        self._moved = time.monotonic()
        self._answered = 0
        self._motion_sent = self._motion_heard = 0

    def through(self, graph: Graph) -> tuple[LastMessages, msg.SfmStatus]:
        """Play every frame, let each node finish, and collect the last messages."""
        self._graph = graph
        self._node = Node("replay")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        try:
            self._connect()
            with self._timed("start", "starting the nodes"):
                self._wait_until(self._is_connected, START_SECONDS, self._missing_connections)
            with self._timed("play", _MOVING[0]):
                played = self._play()
            with self._timed("frames", _MOVING[1]):
                keyframes = self._finish("frames", played)
                self._wait_until(
                    lambda: not self.log.in_flight,
                    DELIVERY_SECONDS,
                    lambda: f"frames decided on {self.log.considered} of {played} images",
                )
            with self._timed("sfm", "reconstructing"):
                self._wait_until(
                    lambda: self._motion_heard >= self._motion_sent,
                    DELIVERY_SECONDS,
                    lambda: f"sfm has heard {self._motion_heard} of {self._motion_sent} messages of motion",
                )
                revision = self._finish("sfm", keyframes)
            if not revision:
                raise InputError(self._status.message or "nothing was reconstructed: no map came from sfm")
            self._receive(PointCloud2, PathMsg)
            with self._timed("detect", "detecting pipes"):
                self._finish("detect", revision)
            self._receive(msg.PipeArray, MarkerArray)
            with self._timed("collect", "collecting the results"):
                return self._collect(revision), self._status
        finally:
            self._executor.shutdown()
            self._node.destroy_node()

    def _connect(self) -> None:
        node = self._node
        image_type, image_topic = IMAGE_TYPES[self._bag.image_type]
        self._images = node.create_publisher(image_type, image_topic, qos.reliable(4 * IN_FLIGHT))
        self._infos = node.create_publisher(CameraInfo, "camera_info", qos.reliable(4 * IN_FLIGHT))
        self._motion = {
            topic: node.create_publisher(kind, topic, qos.kept(KEPT) if topic == TF_STATIC else qos.reliable(KEPT))
            for topic, kind in MOTION_TYPES.items()
            if topic in self._bag.motion_topics.values()
        }
        node.create_subscription(msg.FrameDecision, "frame_decisions", self._on_decision, qos.reliable(1000))
        node.create_subscription(msg.ImageOverlapArray, "image_overlap", self._on_overlap, qos.kept(1000))
        node.create_subscription(msg.SfmStatus, "sfm_status", self._on_status, qos.latched())
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._services = {
            name: node.create_client(srv.Finish, f"{name}/finish") for name in ("frames", "sfm", "detect")
        }

    def _is_connected(self) -> bool:
        return not self._missing_connections()

    def _missing_connections(self) -> str:
        missing = [topic for topic, count in _SUBSCRIBERS.items() if self._node.count_subscribers(topic) < count]
        missing += [name for name, service in self._services.items() if not service.service_is_ready()]
        missing += ["image"] * (not self._images.get_subscription_count())
        missing += [topic for topic, publisher in self._motion.items() if not publisher.get_subscription_count()]
        missing += ["camera_info"] * (not self._infos.get_subscription_count())
        missing += [
            topic
            for topic in ("frame_decisions", "image_overlap", "sfm_status", "pipes", "pipe_markers")
            if not self._node.count_publishers(topic)
        ]
        return f"the nodes have not found each other: {', '.join(missing)}" if missing else ""

    def _play(self) -> int:
        """Send every frame, never more than IN_FLIGHT ahead of the selector; returns how many were sent."""
        played = 0
        begun, first = time.monotonic(), None
        for frame in self._bag.with_motion():
            if isinstance(frame, Motion):
                self._move(frame)
                continue
            first = frame.stamp if first is None else first
            if not cdr.is_whole(frame.data, self._bag.image_type):
                self.log.skip(frame.stamp, "damaged message")
                continue
            while self.log.in_flight >= IN_FLIGHT:
                self._spin()
            if self._rate is not None:
                due = begun + (frame.stamp - first) * 1e-9 / self._rate
                while time.monotonic() < due:
                    self._spin(due - time.monotonic())
                    self._moved = time.monotonic()
            self._send(frame)
            played += 1
            self._spin(0.0)
        if not played:
            raise InputError(f"{self._bag.path}: all {self._bag.image_count} images are damaged")
        return played

    def _send(self, frame: Frame) -> None:
        self.log.play(frame.stamp)
        self._infos.publish(calibration(frame))
        self._images.publish(frame.data)

    def _move(self, message: Motion) -> None:
        """Pass on what a robot told of its motion; a damaged message tells nothing."""
        publisher = self._motion[message.topic]
        try:
            told = deserialize_message(message.data, publisher.msg_type)
        except Exception:  # rclpy raises whatever its type support makes of the bytes
            return
        publisher.publish(told)
        # A message of TF counts for each of its transforms.
        self._motion_sent += len(told.transforms) if hasattr(told, "transforms") else 1
        if self._motion_sent % MOTION_IN_FLIGHT == 0:
            publisher.wait_for_all_acked()

    def _finish(self, name: str, expected: int) -> int:
        """Let a node finish after `expected` inputs; returns how many outputs it has published."""
        future = self._services[name].call_async(srv.Finish.Request(expected_inputs=expected))
        while not future.done():
            self._spin()
        response = future.result()
        if not response.success:
            # With so few keyframes it is the frames left out that explain the failure.
            reasons = self.log.common_reasons() if self.log.chosen < MIN_KEYFRAMES else ""
            message = response.message or f"{name} found nothing to work on"
            raise InputError(f"{message} ({reasons})" if reasons else message)
        return response.outputs

    def _receive(self, *kinds: type) -> None:
        """Take the last message of topics that are complete: who subscribes now gets exactly that (transient local)."""
        for kind in kinds:
            keep = functools.partial(self._latest.__setitem__, kind)
            self._node.create_subscription(kind, _LATCHED[kind], keep, qos.latched())

    def _collect(self, revision: int) -> LastMessages:
        """Wait until the last messages are all of one map."""
        latest = self._latest

        def complete() -> bool:
            if len(latest) < len(_LATCHED) or self._status.map_revision < revision:
                return False
            stamp = latest[msg.PipeArray].header.stamp
            return latest[msg.PipeArray].map_revision >= revision and all(
                latest[kind].header.stamp == stamp for kind in (PointCloud2, PathMsg)
            )

        def missing() -> str:
            if len(latest) < len(_LATCHED):
                return f"of the results came only {len(latest)} of {len(_LATCHED)}"
            return "cloud, poses and pipes are not of one map; does another graph run in this ROS domain?"

        self._wait_until(complete, DELIVERY_SECONDS, missing)
        return LastMessages(latest[PointCloud2], latest[PathMsg], latest[msg.PipeArray], latest[MarkerArray])

    def _spin(self, seconds: float = 0.1) -> None:
        """Handle what has arrived, show where the replay stands, and make sure that every node lives."""
        self._executor.spin_once(timeout_sec=min(max(seconds, 0.0), 0.1))
        self._graph.check()
        now = time.monotonic()
        if self._stage in _MOVING and now - self._moved > STANDSTILL_SECONDS:
            raise NodeFailure(
                f"nothing has moved for {STANDSTILL_SECONDS:.0f} s while {self._stage}: frames has decided on "
                f"{self.log.considered} images, sfm has worked off {self._answered} of {self.log.chosen} keyframes"
            )
        for name, heard in self._heard.items():
            if now - heard > SILENCE_SECONDS:
                raise NodeFailure(f"the node {name} has said nothing for {SILENCE_SECONDS:.0f} s: it hangs")
        self._report(
            State(
                self._stage,
                self._bag.image_count,
                self.log.considered,
                self.log.chosen,
                self._status.keyframes_registered,
            )
        )

    def _wait_until(self, condition: Callable[[], bool], seconds: float, complaint: Callable[[], str]) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise NodeFailure(f"waited {seconds:.0f} s: {complaint()}")
            self._spin()

    @contextlib.contextmanager
    def _timed(self, name: str, stage: str) -> Iterator[None]:
        self._stage = stage
        started = self._moved = time.monotonic()
        yield
        self.timings[name] = round(time.monotonic() - started, 3)

    def _on_decision(self, message: msg.FrameDecision) -> None:
        self._moved = time.monotonic()
        self.log.decide(
            result_files.FrameRow(
                messages.stamp_ns(message.header.stamp),
                message.chosen,
                message.reason,
                overlap_predicted=message.overlap,
                parallax=message.parallax,
                sharpness=message.sharpness,
            )
        )

    def _on_overlap(self, message: msg.ImageOverlapArray) -> None:
        self._moved = time.monotonic()
        self._answered = message.keyframes_considered
        for image in message.images:
            stamp = messages.stamp_ns(image.stamp)
            self.log.overlap(stamp, image.overlap, image.cell_overlap, image.tie_points, image.registered)

    def _on_status(self, message: msg.SfmStatus) -> None:
        self._status = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.partition(":")[0]
            self._heard[name] = time.monotonic()
            if name == "sfm":
                values = {value.key: value.value for value in status.values}
                self._motion_heard = int(values.get("motion", 0))


def calibration(frame: Frame) -> CameraInfo:
    """The calibration in force, under the stamp of its image, as image_transport would pair them."""
    info = deserialize_message(frame.camera_info, CameraInfo)
    info.header = messages.header(frame.stamp, frame.frame_id)
    return info
