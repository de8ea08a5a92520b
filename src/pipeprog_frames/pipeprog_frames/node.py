# SPDX-License-Identifier: Apache-2.0
"""The frame selector as a ROS 2 node: images in, keyframes out."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Bool

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_NAME
from pipeprog_camera.rig import unique_stamp
from pipeprog_frames.acknowledgements import MAX_AHEAD, Answer, Ledger
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import DAMAGED, FAULTS, UNCALIBRATED, Decision
from pipeprog_frames.incoming.arrival import MAX_QUEUE, Arrival, ArrivalQueue
from pipeprog_frames.incoming.decoding import decode_reduced, reduce_image
from pipeprog_frames.incoming.frame_buffer import EncodedFrame
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.stream import UNLOADED_LAG
from pipeprog_frames.rig_selection import ONE, RigSelection
from pipeprog_frames.selection import Selected
from pipeprog_frames.warm_up import warm_up
from pipeprog_msgs.msg import FrameDecision, ImageOverlapArray, KeyframesRetired
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.discovery import stages_subscribed
from pipeprog_node.finish import FinishService
from pipeprog_node.intake import Intake
from pipeprog_node.main import run
from pipeprog_node.parameters import declare, declare_fixed
from pipeprog_node.processes.cores import limit_cores
from pipeprog_node.processes.journal import Journal, journal_of
from pipeprog_node.received import images as received_images
from pipeprog_node.received import keyframes as received_keyframes

ArrivedCalibration = tuple[str, int, Camera | None]  # name of its camera, stamp [ns], None where it cannot be used
STAGES = 2  # nodes of the graph that take keyframes: SfM and detector
KEPT = 50  # keyframes for a node that is started anew: a minute of them, of which it is away for seconds


class KeyframePublisher:
    """The topics of the selector: decisions, keyframes with their calibration, retirements."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._decisions = node.create_publisher(FrameDecision, "frame_decisions", qos.reliable(1000))
        self._images = node.create_publisher(CompressedImage, "keyframes/image/compressed", qos.kept(KEPT))
        self._infos = node.create_publisher(CameraInfo, "keyframes/camera_info", qos.kept(KEPT))
        self._retired = node.create_publisher(KeyframesRetired, "keyframes/retired", qos.kept(KEPT))

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


class FrameInput:
    """The topics of the camera.

    Every image is handed on, one that is refused with the reason: each has its decision, which is what a replay counts.
    A calibration that is refused is handed on as None.
    """

    def __init__(
        self,
        node: Node,
        config: FramesConfig,
        on_image: Callable[[Arrival], None],
        on_calibration: Callable[[ArrivedCalibration], None],
        cameras: Sequence[str],
    ) -> None:
        """`cameras`: names of those whose topics are subscribed; see `_subscribe`."""
        self.intake = Intake(node)
        if config.lockstep and len(cameras) > 1:
            # Topics are not ordered among each other: a player sends all cameras on one, and their frames tell them.
            self._subscribe(config, "", None, on_image, on_calibration, MAX_QUEUE * len(cameras))
            return
        for number, name in enumerate(cameras):
            prefix = f"{name}/" if name != ONE else ""
            self._subscribe(config, prefix, (name, number), on_image, on_calibration)

    def _subscribe(
        self,
        config: FramesConfig,
        prefix: str,
        camera: tuple[str, int] | None,
        on_image: Callable[[Arrival], None],
        on_calibration: Callable[[ArrivedCalibration], None],
        depth: int = MAX_QUEUE,
    ) -> None:
        """The topics that begin with `prefix`: of a camera with this name and number, None: of all cameras."""
        # Live, a late image is worth less than a fresh one; a recording must lose none.
        source = qos.reliable(depth) if config.lockstep else qos.sensor(10)
        subscribe = partial(self.intake.subscribe, profile=source, overriding=qos.OVERRIDABLE)
        info, raw = f"{prefix}camera_info", f"{prefix}image"
        # spot_ros2 has camera/frontleft/compressed beside camera/frontleft/image.
        encoded = [f"{raw}/compressed", *([f"{prefix}compressed"] if prefix else [])]
        subscribe(CameraInfo, info, partial(self._calibration, info, camera), on_calibration)
        for compressed in encoded if config.image_transport != "raw" else ():
            subscribe(CompressedImage, compressed, partial(self._arrival, compressed, camera), on_image)
        if config.image_transport != "compressed":
            subscribe(Image, raw, partial(self._arrival, raw, camera), on_image)

    def _calibration(self, topic: str, camera: tuple[str, int] | None, message: CameraInfo) -> ArrivedCalibration:
        name, number = camera or (message.header.frame_id[:MAX_NAME], 0)
        try:
            info = received_images.camera_info(message)
        except InputError as error:
            self.intake.reject(topic, error)
            return name, unique_stamp(messages.stamp_ns(message.header.stamp), number), None
        return name, unique_stamp(info.stamp, number), info.camera

    def _arrival(self, topic: str, camera: tuple[str, int] | None, message: Image | CompressedImage) -> Arrival:
        name, number = camera or (message.header.frame_id[:MAX_NAME], 0)
        try:
            arrival = _compressed(message) if isinstance(message, CompressedImage) else _raw(message)
        except InputError as error:
            self.intake.reject(topic, error)
            header = message.header
            stamp = messages.stamp_ns(header.stamp)
            arrival = Arrival(stamp, header.frame_id[:MAX_NAME], refusal=f"{DAMAGED}: {error}")
        return arrival if name == ONE else replace(arrival, stamp=unique_stamp(arrival.stamp, number), camera=name)


class FramesNode(Node):
    """Adapter around a Selection."""

    def __init__(self, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("frames", parameter_overrides=list(overrides))
        self._config = declare(self, FramesConfig, extra=("idle", "cameras", "journal"))
        limit_cores(self._config.cores, self.get_logger().warning)
        idle = declare_fixed(self, "idle", False, "take no images, until a survey begins")
        if self._config.policy == "network" and not self._config.lockstep:
            raise InputError("policy = network takes a whole recording: use it with `pipeprog replay`, live use stream")
        cameras = declare_fixed(self, "cameras", "", "what the topics of a rig begin with, between spaces; empty: one")
        self._selection = RigSelection(self._config, cameras.split())
        warm_up()
        self._queue = ArrivalQueue(self._config.lockstep, MAX_QUEUE * len(self._selection.names))
        self._changes: deque[EncodedFrame | list[int]] = deque()  # keyframes to publish; stamps of some to retire
        self._ledger = Ledger(exact=self._config.lockstep)
        self._considered = self._dropped = 0
        self._faults: Counter[str] = Counter()  # images refused, by the beginning of the reason
        self._flushed = self._is_over = self._is_paused = False
        self._passed_over = 0  # images that came while the survey was paused
        self._frame_id = ""  # of the camera, as its last image says

        self._publisher = KeyframePublisher(self)
        self._journal = journal_of(declare_fixed(self, "journal", "", "folder for the journal of a survey"), "frames")
        if self._journal is not None:
            self._take_up(self._journal)
        self._input = FrameInput(
            self,
            self._config,
            self._on_image,
            self._on_calibration,
            () if idle else self._selection.names,
        )
        # A process before this one may have taken answers that count.
        profile = qos.reliable(50) if self._journal is None else qos.kept(50)
        subscribe = self._input.intake.subscribe
        self._overlaps = subscribe(ImageOverlapArray, "image_overlap", _answer, self._on_answer, profile)
        if self._config.lockstep:
            self._connecting = self.create_timer(0.1, self._start_when_connected)
        else:  # a state and no call: a node that is started anew in a pause hears of it, too
            subscribe(Bool, "survey/paused", lambda message: bool(message.data), self._on_paused, qos.latched())
        self._finish = FinishService(self, lambda: self._considered + len(self._queue), self._on_finish)
        self._diagnostics = Diagnostics(self, "keyframes", self._health)

    def destroy_node(self) -> None:
        """Closes the journal with the node."""
        if self._journal is not None:
            self._journal.close()
        super().destroy_node()

    def _take_up(self, journal: Journal) -> None:
        """Counts what is in the journal as published, and publishes the last of it again: it may not have arrived."""
        for number, change in journal.commands():
            self._publish(change, again=number >= journal.end - KEPT)
            self._selection.budget.held += 1 if isinstance(change, EncodedFrame) else -len(change)

    def _publish(self, change: EncodedFrame | list[int], again: bool = True) -> None:
        """Publishes a keyframe or a retirement; without `again` it is counted only."""
        if isinstance(change, EncodedFrame):
            self._ledger.publish(change.stamp)
            if again:
                self._publisher.publish(change)
            return
        self._ledger.retire()
        if again:
            self._publisher.retire(change, self._ledger.published, self._frame_id)

    def _on_calibration(self, calibration: ArrivedCalibration) -> None:
        self._selection.calibrate(*calibration)
        self._drain()

    def _on_image(self, arrival: Arrival) -> None:
        if self._finish.is_due or self._is_over:
            return  # the survey ended with the images before: a camera goes on for ever
        if self._is_paused:
            self._passed_over += 1
            return
        dropped = self._queue.push(arrival)
        self._dropped += len(dropped)
        uncalibrated = self._selection.uncalibrated
        for each in dropped:
            self._considered += 1
            reason = UNCALIBRATED if each.camera in uncalibrated else "dropped: newer images had come"
            self._decide([(Decision(each.stamp, False, each.refusal or reason, frame_id=each.frame_id), None)])
        self._drain()
        if arrival.camera in uncalibrated:
            topic = self.resolve_topic_name(f"{arrival.camera}/camera_info" if arrival.camera else "camera_info")
            self.get_logger().warning(
                f"images without CameraInfo: publish the calibration on {topic}", throttle_duration_sec=10.0
            )

    def _on_paused(self, is_paused: bool) -> None:
        """Takes no images during a pause; the first one after it may show another place."""
        if is_paused != self._is_paused:
            self._is_paused = is_paused
            self._decide(self._selection.begin_anew())
            self._drain()

    def _start_when_connected(self) -> None:
        if self._is_connected():
            self._connecting.cancel()
            self._drain()

    def _is_connected(self) -> bool:
        return self._publisher.is_connected and self._overlaps.get_publisher_count() > 0

    def _on_answer(self, answer: Answer) -> None:
        try:
            self._ledger.receive(answer)
        except InputError as error:
            self._input.intake.reject("image_overlap", error)
            return
        if not self._config.lockstep:
            self._apply_reports(answer.keyframes)
            self._selection.lag(self._ledger.lag)
        self._drain()

    def _on_finish(self) -> None:
        self._flushed = False
        self._drain()

    def _drain(self) -> None:
        """Considers, publishes and finishes as far as the SfM's answers allow; called on every arrival."""
        while self._publish_changes() and self._queue and self._is_ready(self._queue.head):
            arrival = self._queue.pop()
            self._considered += 1
            self._frame_id = arrival.frame_id
            self._decide(self._selection.consider(arrival))
        if self._queue or not self._finish.is_due:
            return
        if not self._flushed:
            self._flushed = True
            self._decide(self._selection.flush())
        while self._publish_changes() and self._ledger.is_answered:
            self._apply_reports(len(self._ledger.published))
            self._revise(self._selection.finish_round())
            if not self._changes:
                self._end()
                return

    def _is_ready(self, arrival: Arrival) -> bool:
        """Whether an image can be decided on. Live, one without a calibration of its size waits for the next image."""
        selection = self._selection
        if selection.is_ready(arrival):
            return True
        cameras = len(selection.names)
        waited = self._finish.is_due or (len(self._queue) > cameras > len(selection.uncalibrated))
        return waited and not self._config.lockstep

    def _end(self) -> None:
        self._is_over = True
        outside = self._selection.report_outside_band()
        for decision in outside:
            self._publisher.announce(decision, self._frame_id)
        if outside:
            self.get_logger().info(f"{len(outside)} keyframes are outside the band: frame_decisions has the reasons")
        published = len(self._ledger.published)
        nothing = (
            "no image could be used as a keyframe: are they sharp, lit and of surfaces with texture, and does "
            "CameraInfo fit them?"
        )
        self._finish.answer(published, "" if published else nothing)

    def _decide(self, selected: Selected) -> None:
        """Announces what became of frames and queues those that were chosen."""
        for decision, frame in selected:
            if decision.reason.startswith(FAULTS):
                self._note_fault(decision)
            self._publisher.announce(decision, decision.frame_id or self._frame_id)
            if frame is not None:
                self._changes.append(frame)

    def _note_fault(self, decision: Decision) -> None:
        fault = decision.reason.partition(":")[0]
        self._faults[fault] += 1
        if self._faults[fault] == 1:
            self.get_logger().error(
                f"image {decision.stamp} is not used: {decision.reason}; more of this kind are counted in /diagnostics"
            )

    def _revise(self, selected: Selected) -> None:
        """Queues what the overlap reports ask for: frames to add, and keyframes to retire."""
        self._decide(selected)
        retired = [decision.stamp for decision, _ in selected if not decision.chosen]
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
            if self._journal is not None:
                self._write_down(self._journal, change)
            self._publish(change)
        return True

    def _write_down(self, journal: Journal, change: EncodedFrame | list[int]) -> None:
        try:
            journal.write(journal.end, change)
        except OSError as error:
            self.get_logger().error(f"not in the journal of the survey: {error.strerror}", throttle_duration_sec=10.0)

    def _apply_reports(self, keyframes: int) -> None:
        """Uses the answers to the first `keyframes` keyframes; later ones wait, so that a replay repeats itself."""
        for answer in self._ledger.answers(keyframes):
            self._revise(self._selection.answer(answer.reports, answer.readout))

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "frames considered": self._considered,
            "keyframes": len(self._ledger.published),
            "keyframes in the map": self._selection.budget.held,
            "keyframes that the SfM is behind": self._ledger.lag,
            "damaged": self._faults[DAMAGED],
            "dropped": self._dropped,
            "queued": len(self._queue),
            "passed over while the survey was paused": self._passed_over,
            **{f"frames refused: {fault}": count for fault, count in sorted(self._faults.items())},
            **self._input.intake.health(),
        }
        if self._is_paused:
            return DiagnosticStatus.OK, "the survey is paused: images are passed over", values
        if uncalibrated := self._selection.uncalibrated:
            of = f" of {', '.join(uncalibrated)}" if any(uncalibrated) else ""
            return DiagnosticStatus.WARN, f"no usable CameraInfo yet{of}", values
        if self._selection.budget.is_full:
            most = self._config.max_keyframes
            return DiagnosticStatus.WARN, f"max_keyframes = {most} is reached: no further ones are chosen", values
        if self._selection.overlap_min < self._config.overlap_min:
            fewer = f"fewer keyframes, at an overlap of {self._selection.overlap_min:.2f}"
            lags = self._ledger.lag > UNLOADED_LAG
            why = "the SfM cannot keep up" if lags else "max_keyframes is near"
            return DiagnosticStatus.WARN, f"{why}: {fewer}", values
        if self._dropped:
            return DiagnosticStatus.WARN, "frames were dropped: the machine cannot keep up", values
        if self._input.intake.lost:
            return DiagnosticStatus.WARN, "messages were lost on the way to this node: the counts say which", values
        if self._faults or self._input.intake.rejected:
            return DiagnosticStatus.WARN, "messages or frames were refused: the counts say which", values
        return DiagnosticStatus.OK, "selecting", values


def _compressed(message: CompressedImage) -> Arrival:
    image = received_images.compressed_image(message)
    encoded = image.encoded
    load = partial(decode_reduced, encoded, image.width)
    return Arrival(image.stamp, image.frame_id, (image.width, image.height), len(encoded), lambda: encoded, load)


def _raw(message: Image) -> Arrival:
    image = received_images.raw_image(message)
    pixels = image.pixels
    size = pixels.shape[1], pixels.shape[0]
    encode, load = partial(messages.encode_jpeg, pixels), partial(reduce_image, pixels)
    return Arrival(image.stamp, image.frame_id, size, pixels.nbytes, encode, load)


def _answer(message: ImageOverlapArray) -> Answer:
    answer = received_keyframes.image_overlaps(message)
    reports = tuple(OverlapReport(**vars(image)) for image in answer.images)
    return Answer(answer.stamp, answer.keyframes, answer.retirements, reports, answer.readout)


def main() -> None:
    """Entry point of frames_node."""
    run(FramesNode, renewed=("idle", "journal"))


if __name__ == "__main__":
    main()
