# SPDX-License-Identifier: Apache-2.0
"""The frame selector as a ROS 2 node: images in, keyframes out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_frames.acknowledgements import MAX_AHEAD, Answer, Ledger
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.decoding import GrayImage, decode_reduced, is_cut_off, reduce_image, reduced_size
from pipeprog_frames.frame_buffer import EncodedFrame, FrameFile, FrameRing, FrameStore
from pipeprog_frames.frame_decision import DAMAGED, Decision, Load
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.selection_policy import Policy, make_policy
from pipeprog_frames.stream import KeyframeStream
from pipeprog_msgs.msg import FrameDecision, ImageOverlap, ImageOverlapArray, KeyframesRetired
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.discovery import stages_subscribed
from pipeprog_node.main import run
from pipeprog_node.parameters import declare

MAX_QUEUE = 30  # frames that wait, live: one second of a fast camera; older ones would only be late
STAGES = 2  # nodes of the graph that take keyframes: SfM and detector


class KeyframePublisher:
    """The topics of the selector: decisions, keyframes with their calibration, retirements."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._decisions = node.create_publisher(FrameDecision, "frame_decisions", qos.reliable(1000))
        self._images = node.create_publisher(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._infos = node.create_publisher(CameraInfo, "keyframes/camera_info", qos.reliable(50))
        self._retired = node.create_publisher(KeyframesRetired, "keyframes/retired", qos.reliable(50))

    @property
    def is_connected(self) -> bool:
        """Whether SfM and detector receive keyframes: what is published before is lost. Viewers do not count."""
        topics = (self._images, self._infos)
        return all(
            topic.get_subscription_count() >= STAGES and len(stages_subscribed(self._node, topic.topic_name)) >= STAGES
            for topic in topics
        )

    def announce(self, decision: Decision, frame_id: str) -> None:
        """Publishes what became of a frame."""
        self._decisions.publish(
            FrameDecision(
                header=messages.header(decision.stamp, frame_id),
                chosen=decision.chosen,
                reason=decision.reason,
                overlap=float(decision.overlap),
                parallax=float(decision.parallax),
                sharpness=float(decision.sharpness),
            )
        )

    def publish(self, frame: EncodedFrame) -> None:
        """Publishes a keyframe."""
        self._images.publish(messages.compressed_image(frame.stamp, frame.frame_id, frame.encoded))
        self._infos.publish(messages.info_from_camera(frame.camera, frame.stamp, frame.frame_id))

    def retire(self, stamps: Sequence[int], published: Sequence[int], frame_id: str) -> None:
        """Takes keyframes back; the SfM applies it after as many keyframes as are `published`."""
        self._retired.publish(
            KeyframesRetired(
                header=messages.header(max(published), frame_id),
                keyframes_published=len(published),
                stamps=[messages.time_msg(stamp) for stamp in stamps],
            )
        )


class FramesNode(Node):
    """Adapter around a Policy."""

    def __init__(self) -> None:
        super().__init__("frames")
        self._config = declare(self, FramesConfig)
        if self._config.policy == "network" and not self._config.lockstep:
            raise InputError("policy = network takes a whole recording: use it with `pipeprog replay`, live use stream")
        self._camera: Camera | None = None
        self._policy: Policy | None = None
        # In a replay the disk that holds the recording can hold its images, too.
        self._ring: FrameStore = FrameFile() if self._config.lockstep else FrameRing(self._config.buffer_mib << 20)
        self._queue: deque[Image | CompressedImage] = deque()
        self._changes: deque[EncodedFrame | list[int]] = deque()  # keyframes to publish; stamps of some to retire
        self._ledger = Ledger()
        self._considered = self._damaged = self._dropped = 0
        self._finish: tuple[int, Future] | None = None
        self._flushed = False
        self._frame_id = ""  # of the camera, as its last image says

        self._publisher = KeyframePublisher(self)
        # Live, a late image is worth less than a fresh one; a recording must lose none.
        source = qos.reliable(MAX_QUEUE) if self._config.lockstep else qos.sensor(10)
        subscribe = partial(self.create_subscription, qos_profile=source, qos_overriding_options=qos.OVERRIDABLE)
        subscribe(CameraInfo, "camera_info", self._on_camera_info)
        if self._config.image_transport != "raw":
            subscribe(CompressedImage, "image/compressed", self._on_image)
        if self._config.image_transport != "compressed":
            subscribe(Image, "image", self._on_image)
        self._overlaps = self.create_subscription(
            ImageOverlapArray, "image_overlap", self._on_overlap, qos.reliable(50)
        )
        if self._config.lockstep:
            self._connecting = self.create_timer(0.1, self._start_when_connected)
        # In a group of its own: while it waits for the end, the other callbacks must run.
        self.create_service(Finish, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup())
        self._diagnostics = Diagnostics(self, "keyframes", self._health)

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            camera = messages.camera_from_info(message)
        except InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        if camera != self._camera:
            self._camera = camera
            self._policy = self._policy or make_policy(self._config, camera, self._ring.sharpest_between)
        self._drain()

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._queue.append(message)
        if len(self._queue) > MAX_QUEUE and not self._config.lockstep:
            self._queue.popleft()
            self._dropped += 1
        if self._camera is None:
            self.get_logger().warning(
                f"images without CameraInfo: publish the calibration on {self.resolve_topic_name('camera_info')}",
                throttle_duration_sec=10.0,
            )
        self._drain()

    def _start_when_connected(self) -> None:
        if self._is_connected():
            self._connecting.cancel()
            self._drain()

    def _is_connected(self) -> bool:
        return self._publisher.is_connected and self._overlaps.get_publisher_count() > 0

    def _on_overlap(self, message: ImageOverlapArray) -> None:
        self._ledger.receive(_answer(message))
        if not self._config.lockstep:
            self._apply_reports(message.keyframes_considered)
            if isinstance(self._policy, KeyframeStream):
                self._policy.lag(self._ledger.lag)
        self._drain()

    async def _on_finish(self, request: Finish.Request, response: Finish.Response) -> Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._flushed = False
        self._drain()
        await done
        published = len(self._ledger.published)
        response.success = published > 0
        response.message = "" if published else "no image could be used as a keyframe: see frame_decisions"
        response.outputs = published
        return response

    def _drain(self) -> None:
        """Considers, publishes and finishes as far as the SfM's answers allow; called on every arrival."""
        while self._publish_changes() and self._queue and self._policy is not None:
            self._consider(self._queue.popleft())
        if self._finish is None or self._considered < self._finish[0]:
            return
        if self._policy is not None and not self._flushed:
            self._flushed = True
            self._decide(self._policy.flush())
        while self._publish_changes() and self._ledger.is_answered:
            self._apply_reports(len(self._ledger.published))
            if self._policy is not None:
                self._revise(self._policy.finish_round())
            if not self._changes:
                self._end()
                return

    def _end(self) -> None:
        assert self._finish is not None
        outside = self._policy.report_outside_band() if self._policy is not None else []
        for decision in outside:
            self._publisher.announce(decision, self._frame_id)
        if outside:
            self.get_logger().info(f"{len(outside)} keyframes are outside the band: frame_decisions has the reasons")
        done = self._finish[1]
        self._finish = None
        done.set_result(None)

    def _consider(self, message: Image | CompressedImage) -> None:
        assert self._camera is not None
        assert self._policy is not None
        self._considered += 1
        self._frame_id = message.header.frame_id
        stamp = messages.stamp_ns(message.header.stamp)
        encoded, load = self._open(message, self._camera)
        if encoded:
            self._ring.add(EncodedFrame(stamp, message.header.frame_id, encoded, self._camera))
        self._decide(self._policy.consider(stamp, load if encoded else None))

    def _open(self, message: Image | CompressedImage, camera: Camera) -> tuple[bytes, Load]:
        """The image's compressed bytes (none: damaged), and what decodes it reduced and grey."""
        if isinstance(message, CompressedImage):
            encoded = bytes(message.data)
            return b"" if is_cut_off(encoded) else encoded, lambda: self._fitting(
                decode_reduced(encoded, camera.width), camera
            )
        try:
            image = messages.image_from_msg(message)
        except InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return b"", lambda: None
        gray = self._fitting(reduce_image(image), camera)
        return messages.encode_jpeg(image), lambda: gray

    def _fitting(self, gray: GrayImage | None, camera: Camera) -> GrayImage | None:
        """The reduced image, if it has the size that the calibration is for."""
        if gray is None or (gray.shape[1], gray.shape[0]) == reduced_size(camera.width, camera.height):
            return gray
        self.get_logger().error(
            f"images do not have the size of CameraInfo ({camera.width} x {camera.height}): "
            "calibrate at the size that the camera sends",
            throttle_duration_sec=10.0,
        )
        return None

    def _decide(self, decisions: list[Decision]) -> None:
        """Announces what became of frames and queues those that were chosen."""
        for decision in decisions:
            self._damaged += decision.reason == DAMAGED
            self._publisher.announce(decision, self._frame_id)
            frame = self._ring.get(decision.stamp) if decision.chosen else None
            if frame is not None:
                self._changes.append(frame)

    def _revise(self, decisions: list[Decision]) -> None:
        """Queues what the overlap reports ask for: frames to add, and keyframes to retire."""
        self._decide(decisions)
        retired = [decision.stamp for decision in decisions if not decision.chosen]
        if retired:
            self._changes.append(retired)

    def _publish_changes(self) -> bool:
        """Publishes what is queued; False while the SfM must catch up first (lockstep)."""
        while self._changes:
            if self._config.lockstep:
                published = len(self._ledger.published)
                if not self._ledger.may_publish or (not published and not self._is_connected()):
                    return False
                self._apply_reports(published + 1 - MAX_AHEAD)
            change = self._changes.popleft()
            if isinstance(change, EncodedFrame):
                self._ledger.publish(change.stamp)
                self._publisher.publish(change)
            else:
                self._ledger.retire()
                self._publisher.retire(change, self._ledger.published, self._frame_id)
        return True

    def _apply_reports(self, keyframes: int) -> None:
        """Uses the answers to the first `keyframes` keyframes; later ones wait, so that a replay repeats itself."""
        for reports in self._ledger.reports(keyframes):
            if self._policy is not None:
                self._revise(self._policy.answer(reports))

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "frames considered": self._considered,
            "keyframes": len(self._ledger.published),
            "keyframes that the SfM is behind": self._ledger.lag,
            "damaged": self._damaged,
            "dropped": self._dropped,
            "queued": len(self._queue),
        }
        if self._camera is None:
            return DiagnosticStatus.WARN, "no usable CameraInfo yet", values
        if isinstance(self._policy, KeyframeStream) and self._policy.overlap_min < self._config.overlap_min:
            fewer = f"fewer keyframes, at an overlap of {self._policy.overlap_min:.2f}"
            return DiagnosticStatus.WARN, f"the SfM cannot keep up: {fewer}", values
        if self._dropped:
            return DiagnosticStatus.WARN, "frames were dropped: the machine cannot keep up", values
        return DiagnosticStatus.OK, "selecting", values


def _answer(message: ImageOverlapArray) -> Answer:
    return Answer(
        messages.stamp_ns(message.header.stamp),
        message.keyframes_considered,
        message.retirements_considered,
        tuple(_report(image) for image in message.images),
    )


def _report(image: ImageOverlap) -> OverlapReport:
    return OverlapReport(
        messages.stamp_ns(image.stamp),
        image.registered,
        image.overlap,
        image.cell_overlap,
        image.matches_previous,
        image.matches_next,
    )


def main() -> None:
    """Entry point of frames_node."""
    run(FramesNode)


if __name__ == "__main__":
    main()
