"""The frame selector as a ROS 2 node: images in, keyframes out."""

from __future__ import annotations

from collections import deque
from functools import partial
from itertools import pairwise
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.decoding import GrayImage, decode_reduced, is_cut_off, reduce_image, reduced_size
from pipeprog_frames.ring import Frame, FrameRing
from pipeprog_frames.selector import DAMAGED, Decision, FrameSelector, Load
from pipeprog_msgs.msg import FrameDecision, ImageOverlapArray
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.main import run
from pipeprog_node.parameters import declare

MAX_QUEUE = 30  # one second of a fast camera; more would only be late
LISTENERS = 2  # in lockstep: SfM and detector, without whom the first keyframe would be lost
MAX_AHEAD = 2  # in lockstep: keyframes that the SfM may still be working on when the next is published


class FramesNode(Node):
    """Adapter around FrameSelector."""

    def __init__(self) -> None:
        super().__init__("frames")
        self._config = declare(self, FramesConfig)
        self._camera: Camera | None = None
        self._selector: FrameSelector | None = None
        self._ring = FrameRing(self._config.buffer_mib << 20)
        self._queue: deque[Image | CompressedImage] = deque()
        self._keyframes: deque[Frame] = deque()  # chosen, not yet published
        self._feedback: deque[ImageOverlapArray] = deque()
        self._published: list[int] = []
        self._acknowledged = 0
        self._considered = self._damaged = self._dropped = 0
        self._finish: tuple[int, Future] | None = None

        self._decisions = self.create_publisher(FrameDecision, "frame_decisions", qos.reliable(1000))
        self._images = self.create_publisher(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._infos = self.create_publisher(CameraInfo, "keyframes/camera_info", qos.reliable(50))
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
            self._selector = self._selector or FrameSelector(self._config, camera)
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
        """Whether the SfM and the detector hear the keyframes: what is published before is never heard."""
        listeners = min(self._images.get_subscription_count(), self._infos.get_subscription_count())
        return listeners >= LISTENERS and self._overlaps.get_publisher_count() > 0

    def _on_overlap(self, message: ImageOverlapArray) -> None:
        self._acknowledged = max(self._acknowledged, message.keyframes_considered)
        self._feedback.append(message)
        self._drain()

    async def _on_finish(self, request: Finish.Request, response: Finish.Response) -> Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._drain()
        await done
        response.success = bool(self._published)
        response.message = "" if self._published else "no image could be used as a keyframe: see frame_decisions"
        response.outputs = len(self._published)
        return response

    def _drain(self) -> None:
        """Works off what can be worked off now; called on every arrival."""
        while self._publish_keyframes() and self._queue and self._selector is not None:
            self._consider(self._queue.popleft())
        if self._finish is None or self._considered < self._finish[0] or self._keyframes:
            return
        if self._selector is not None:
            self._decide(self._selector.flush())
        if self._publish_keyframes() and self._acknowledged >= len(self._published):
            self._apply_feedback(len(self._published))
            if self._publish_keyframes() and self._acknowledged >= len(self._published):
                done = self._finish[1]
                self._finish = None
                done.set_result(None)

    def _consider(self, message: Image | CompressedImage) -> None:
        assert self._camera is not None
        assert self._selector is not None
        self._considered += 1
        stamp = messages.stamp_ns(message.header.stamp)
        encoded, load = self._open(message, self._camera)
        if encoded:
            self._ring.add(Frame(stamp, message.header.frame_id, encoded, self._camera))
        self._decide(self._selector.consider(stamp, load if encoded else None))

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
        for decision in decisions:
            self._damaged += decision.reason == DAMAGED
            frame = self._ring.get(decision.stamp)
            self._decisions.publish(
                FrameDecision(
                    header=messages.header(decision.stamp, frame.frame_id if frame else ""),
                    chosen=decision.chosen,
                    reason=decision.reason,
                    overlap=float(decision.overlap),
                    parallax=float(decision.parallax),
                    sharpness=float(decision.sharpness),
                )
            )
            if decision.chosen and frame is not None:
                self._keyframes.append(frame)

    def _publish_keyframes(self) -> bool:
        """Publishes what is chosen; False while the SfM must catch up first (lockstep)."""
        while self._keyframes:
            if self._config.lockstep:
                if not self._published and not self._is_connected():
                    return False
                if len(self._published) - self._acknowledged >= MAX_AHEAD:
                    return False
                self._apply_feedback(len(self._published) + 1 - MAX_AHEAD)
            else:
                self._apply_feedback(len(self._published))
            frame = self._keyframes.popleft()
            self._published.append(frame.stamp)
            self._images.publish(messages.compressed_image(frame.stamp, frame.frame_id, frame.encoded))
            self._infos.publish(messages.info_from_camera(frame.camera, frame.stamp, frame.frame_id))
        return True

    def _apply_feedback(self, count: int) -> None:
        """Uses the SfM's answers to the first `count` keyframes; later ones wait, so that a replay repeats itself."""
        while self._feedback and self._feedback[0].keyframes_considered <= count:
            for image in self._feedback.popleft().images:
                if not image.registered:
                    self._bridge(messages.stamp_ns(image.stamp))

    def _bridge(self, stamp: int) -> None:
        """A keyframe that does not register gets a frame before and a frame after it (Algorithm 1)."""
        keyframes = sorted({*self._published, *(frame.stamp for frame in self._keyframes)})
        for first, second in pairwise(keyframes):
            if stamp in (first, second):
                frame = self._ring.middle(first, second)
                if frame is not None:
                    self._decide([Decision(frame.stamp, True, "bridges to a keyframe that did not register")])

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "frames considered": self._considered,
            "keyframes": len(self._published),
            "damaged": self._damaged,
            "dropped": self._dropped,
            "queued": len(self._queue),
        }
        if self._camera is None:
            return DiagnosticStatus.WARN, "no usable CameraInfo yet", values
        if self._dropped:
            return DiagnosticStatus.WARN, "frames were dropped: the machine cannot keep up", values
        return DiagnosticStatus.OK, "selecting", values


def main() -> None:
    """Entry point of frames_node."""
    run(FramesNode)


if __name__ == "__main__":
    main()
