# SPDX-License-Identifier: Apache-2.0
"""The selector's node between a camera and an SfM that answers as it is told, all in this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Bool

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_frames.incoming.frame_buffer import EncodedFrame
from pipeprog_frames.node import KEPT, FramesNode
from pipeprog_msgs.msg import FrameDecision, ImageOverlap, ImageOverlapArray, KeyframesRetired
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from pipeprog_node.processes.journal import Journal
from tests.fuzz.fuzzed_messages import png_header

CAMERA = Camera(640, 360, 450.0, 450.0, 319.5, 179.5)
START = 1_700_000_000_000_000_000
PASSED_OVER = "passed over while the survey was paused"


@pytest.fixture(scope="module")
def wall() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).standard_normal((400, 6400)).astype(np.float32)
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (3.0, 10.0, 30.0))
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def view(wall: NDArray[np.uint8], x: int) -> NDArray[np.uint8]:
    return np.ascontiguousarray(wall[20:380, x : x + 640])


class Stage:
    """The node under test, the camera's topics, and what the SfM hears and answers."""

    def __init__(
        self, arguments: list[str], image_type: type, image: str, camera_info: str, idle: bool = False
    ) -> None:
        rclpy.init(args=["--ros-args", "--log-level", "error", *arguments])
        self.node = FramesNode()
        self.others = Node("others")
        self._added: list[Node] = []
        self.keyframes: list[CompressedImage] = []
        self.decisions: list[FrameDecision] = []
        self.retired: list[KeyframesRetired] = []
        self.health: list[DiagnosticStatus] = []
        listen = self.others.create_subscription
        listen(CompressedImage, "keyframes/image/compressed", self.keyframes.append, qos.reliable(50))
        listen(FrameDecision, "frame_decisions", self.decisions.append, qos.reliable(1000))
        listen(KeyframesRetired, "keyframes/retired", self.retired.append, qos.reliable(50))
        listen(DiagnosticArray, "/diagnostics", lambda message: self.health.extend(message.status), 10)
        self._images = self.others.create_publisher(image_type, image, qos.reliable(50))
        self._infos = self.others.create_publisher(CameraInfo, camera_info, qos.reliable(50))
        self._overlaps = self.others.create_publisher(ImageOverlapArray, "image_overlap", qos.kept(50))
        self._executor = SingleThreadedExecutor()
        for node in (self.node, self.others):
            self._executor.add_node(node)
        self.spin_until(
            lambda: (
                (idle or min(topic.get_subscription_count() for topic in (self._images, self._infos)) > 0)
                and self._overlaps.get_subscription_count() > 0
                and self.others.count_publishers("keyframes/image/compressed") > 0
            )
        )

    def add_node(self, name: str, stage: bool) -> Node:
        """A node that subscribes to keyframes: one of the graph's stages, which offer Finish, or a viewer."""
        node = Node(name)
        node.create_subscription(CompressedImage, "keyframes/image/compressed", lambda _: None, qos.reliable(50))
        node.create_subscription(CameraInfo, "keyframes/camera_info", lambda _: None, qos.reliable(50))
        if stage:
            node.create_service(Finish, "~/finish", lambda request, response: response)
        self.host(node)
        return node

    def host(self, node: Node) -> None:
        """Has another node run beside the others."""
        self._executor.add_node(node)
        self._added.append(node)

    def close(self) -> None:
        self._executor.shutdown()
        for node in (self.node, self.others, *self._added):
            node.destroy_node()
        rclpy.try_shutdown()

    def spin_until(self, condition: Callable[[], object], seconds: float = 20.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.02)

    def show(self, stamp: int, image: Image | CompressedImage) -> None:
        """One image with its calibration, and all that follows from it."""
        considered = self._counted("frames considered")
        self._infos.publish(messages.info_from_camera(CAMERA, stamp, image.header.frame_id))
        self._images.publish(image)
        self.spin_until(lambda: self._counted("frames considered") > considered)
        self.spin_until(lambda: len(self.keyframes) == self._counted("keyframes"))

    def pass_over(self, image: CompressedImage) -> None:
        """One image that comes in a pause."""
        passed_over = self._counted(PASSED_OVER)
        self._images.publish(image)
        self.spin_until(lambda: self._counted(PASSED_OVER) > passed_over)

    def has_considered(self, more_than: int) -> bool:
        return self._counted("frames considered") > more_than

    def _counted(self, what: str) -> int:
        return int(self.node._health()[2][what])

    def publish_answer(self, message: ImageOverlapArray) -> None:
        self._overlaps.publish(message)

    def answer(self, stamp: int, count: int, images: list[ImageOverlap]) -> None:
        header = messages.header(stamp, "camera")
        self.publish_answer(ImageOverlapArray(header=header, keyframes_considered=count, images=images))

    def chosen(self) -> list[int]:
        return [messages.stamp_ns(message.header.stamp) for message in self.keyframes]


@pytest.fixture
def stage() -> Iterator[Callable[..., Stage]]:
    stages = []

    def make(
        *arguments: str,
        image_type: type = CompressedImage,
        image: str = "image/compressed",
        camera_info: str = "camera_info",
        idle: bool = False,
    ) -> Stage:
        stages.append(Stage(list(arguments), image_type, image, camera_info, idle))
        return stages[-1]

    yield make
    for each in stages:
        each.close()


def compressed(stamp: int, image: NDArray[np.uint8], kind: str = "jpeg", frame: str = "camera") -> CompressedImage:
    message = messages.compressed_image(stamp, frame, cv2.imencode(".jpg", image)[1].tobytes())
    message.format = kind
    return message


def report(stamp: int, overlap: float, before: int, after: int) -> ImageOverlap:
    return ImageOverlap(
        stamp=messages.time_msg(stamp),
        registered=True,
        overlap=overlap,
        cell_overlap=overlap,
        matches_previous=before,
        matches_next=after,
    )


def test_a_survey_that_is_taken_up_has_its_last_keyframes_published_again(
    stage: Callable[..., Stage], tmp_path: Path
) -> None:
    """They may not have arrived; nodes that are started anew themselves get them as well."""
    journal = Journal(tmp_path / "frames.journal")
    for number in range(KEPT + 2):
        journal.write(number, EncodedFrame(START + number, "camera", b"a JPEG", CAMERA))
    journal.write(journal.end, [START])
    journal.close()
    scene = stage("-p", "idle:=true", "-p", f"journal:={tmp_path}", idle=True)
    scene.keyframes.clear()
    listen = scene.others.create_subscription
    listen(CompressedImage, "keyframes/image/compressed", scene.keyframes.append, qos.kept(2 * KEPT))
    listen(KeyframesRetired, "keyframes/retired", scene.retired.append, qos.kept(KEPT))
    scene.spin_until(lambda: len(scene.keyframes) >= KEPT - 1 and scene.retired)
    assert scene.chosen() == [START + number for number in range(3, KEPT + 2)]
    assert scene.retired[-1].keyframes_published == KEPT + 2
    assert scene._counted("keyframes") == KEPT + 2
    assert scene._counted("keyframes in the map") == KEPT + 1  # one is retired


def test_cameras_that_are_triggered_together_have_stamps_of_their_own(
    stage: Callable[..., Stage], wall: NDArray
) -> None:
    """Equal stamps, which the SfM and the detector know keyframes by; live, each camera has its topics."""
    scene = stage("-p", "cameras:=left right", image="left/image/compressed", camera_info="left/camera_info")
    others = scene.others
    images = others.create_publisher(CompressedImage, "right/image/compressed", qos.reliable(10))
    infos = others.create_publisher(CameraInfo, "right/camera_info", qos.reliable(10))
    scene.spin_until(lambda: images.get_subscription_count() and infos.get_subscription_count())
    for index in range(16):
        stamp = START + index * 200_000_000
        considered = scene._counted("frames considered")
        infos.publish(messages.info_from_camera(CAMERA, stamp, "right_optical"))
        images.publish(compressed(stamp, view(wall, 3000 - 30 * index), frame="right_optical"))
        scene.spin_until(partial(scene.has_considered, considered))
        scene.show(stamp, compressed(stamp, view(wall, 30 * index), frame="left_optical"))
    of = {messages.stamp_ns(message.header.stamp): message.header.frame_id for message in scene.keyframes}
    assert len(of) == len(scene.keyframes)
    assert {stamp % 10 for stamp, frame in of.items() if frame == "left_optical"} == {0}
    assert {stamp % 10 for stamp, frame in of.items() if frame == "right_optical"} == {1}
    scene.spin_until(lambda: len(scene.decisions) >= 2 * 10)
    told = {(messages.stamp_ns(one.header.stamp) % 10, one.header.frame_id) for one in scene.decisions}
    assert told == {(0, "left_optical"), (1, "right_optical")}


def test_one_of_several_grey_cameras_with_irregular_stamps(stage: Callable[..., Stage], wall: NDArray) -> None:
    """As a Spot gives them: five raw grey cameras, each with its topics, at 2 to 15 Hz."""
    names = {"image": "/camera/frontleft/image", "camera_info": "/camera/frontleft/camera_info"}
    remap = [word for name, topic in names.items() for word in ("-r", f"{name}:={topic}")]
    scene = stage("-p", "image_transport:=raw", *remap, image_type=Image, **names)
    other = scene.others.create_publisher(Image, "/camera/frontright/image", qos.reliable(10))
    stamp, shown = START, []
    for index, gap in enumerate(np.random.default_rng(1).uniform(1 / 15, 1 / 2, 24)):
        stamp += int(gap * 1e9)
        pixels = view(wall, 30 * index)
        for frame, publish in (("frontright", other.publish), ("frontleft", None)):
            message = Image(header=messages.header(stamp, frame), height=360, width=640, encoding="mono8", step=640)
            message.data = pixels.tobytes()
            scene.show(stamp, message) if publish is None else publish(message)
        shown.append(stamp)
    assert {message.header.frame_id for message in scene.keyframes} == {"frontleft"}
    chosen = scene.chosen()
    assert set(chosen) <= set(shown)
    places = [30 * shown.index(stamp) for stamp in chosen]
    assert len(chosen) >= 6
    assert np.diff(places).max() <= 0.15 * 640


@pytest.mark.parametrize("kind", ["", "JPG", "mono8; jpeg compressed ", "rgb8; jpeg compressed bgr8", "png"])
def test_whatever_the_format_says(stage: Callable[..., Stage], wall: NDArray, kind: str) -> None:
    scene = stage()
    for index in range(8):
        stamp = START + index * 200_000_000
        scene.show(stamp, compressed(stamp, view(wall, 80 * index), kind))
    scene.spin_until(lambda: len(scene.keyframes) >= 6)


def test_an_image_that_comes_twice_takes_no_keyframe_back(stage: Callable[..., Stage], wall: NDArray) -> None:
    scene = stage()
    for index in range(6):
        stamp = START + index * 200_000_000
        for _ in range(2):
            scene.show(stamp, compressed(stamp, view(wall, 80 * index)))
    scene.spin_until(lambda: len(scene.decisions) >= 11)
    assert sum(decision.reason == "stamp repeats" for decision in scene.decisions) == 6
    assert len(set(scene.chosen())) == len(scene.chosen()) >= 5
    assert not scene.retired


def test_live_a_lagging_sfm_gets_fewer_keyframes_and_diagnostics_say_so(
    stage: Callable[..., Stage], wall: NDArray
) -> None:
    scene = stage()
    for index in range(100):
        stamp = START + index * 200_000_000
        scene.show(stamp, compressed(stamp, view(wall, 50 * index)))
        if scene.keyframes and index < 40:  # the SfM works off the first keyframe and no more
            first = scene.chosen()[0]
            scene.answer(first, 1, [report(first, 1.0, 0, 0)])
    chosen = [(stamp - START) // 200_000_000 for stamp in scene.chosen()]
    early = sum(index < 20 for index in chosen)
    late = sum(20 <= index < 40 for index in chosen)
    assert late < early
    scene.health.clear()
    scene.spin_until(lambda: any("cannot keep up" in status.message for status in scene.health))


def test_what_the_sfm_answers_adds_and_retires_keyframes(stage: Callable[..., Stage], wall: NDArray) -> None:
    scene = stage()
    for index in range(40):
        stamp = START + index * 33_000_000
        scene.show(stamp, compressed(stamp, view(wall, 20 * index)))
    chosen = scene.chosen()
    assert len(chosen) >= 5
    reports = [report(stamp, 0.95, 500, 500) for stamp in chosen]
    reports[2] = report(chosen[2], 0.5, 500, 100)
    scene.answer(chosen[-1], len(chosen), reports)
    scene.spin_until(lambda: len(scene.keyframes) > len(chosen))
    added = scene.chosen()[-1]
    assert chosen[2] < added < chosen[3]
    scene.spin_until(lambda: any("0.50 < 0.85" in decision.reason for decision in scene.decisions))
    assert not scene.retired, "the selector has left none out that the overlap does not ask for"


def test_a_rolling_shutter_gets_keyframes_that_are_dense_in_time(stage: Callable[..., Stage], wall: NDArray) -> None:
    scene = stage()
    for index in range(60):
        stamp = START + index * 33_000_000
        scene.show(stamp, compressed(stamp, view(wall, 4 * index)))
    chosen = scene.chosen()
    assert max(np.diff(chosen)) > 400_000_000
    scene.publish_answer(
        ImageOverlapArray(
            header=messages.header(chosen[-1], "camera"),
            keyframes_considered=len(chosen),
            images=[report(stamp, 0.86, 500, 500) for stamp in chosen],
            readout=0.015,
        )
    )
    scene.spin_until(lambda: len(scene.keyframes) > len(chosen))
    scene.spin_until(lambda: any("rolling shutter" in decision.reason for decision in scene.decisions))


def test_a_recording_becomes_a_network(stage: Callable[..., Stage], wall: NDArray) -> None:
    """0.5 frames a second, of which the SfM's answers leave every second one, until no group is above the band."""
    scene = stage("-p", "policy:=network", "-p", "lockstep:=true")
    scene.add_node("reconstruction", stage=True)
    scene.add_node("pipes", stage=True)
    images: set[int] = set()
    done = [0, 0]

    def answer() -> None:
        reports = [report(stamp, 0.99 if len(images) > 4 else 0.86, 500, 500) for stamp in sorted(images)]
        scene.publish_answer(
            ImageOverlapArray(
                header=messages.header(max(images), "camera"),
                keyframes_considered=done[0],
                retirements_considered=done[1],
                images=reports,
            )
        )

    def on_keyframe(message: CompressedImage) -> None:
        images.add(messages.stamp_ns(message.header.stamp))
        done[0] += 1
        answer()

    def on_retired(message: KeyframesRetired) -> None:
        assert message.keyframes_published == done[0]
        images.difference_update(messages.stamp_ns(stamp) for stamp in message.stamps)
        done[1] += 1
        answer()

    scene.others.create_subscription(CompressedImage, "keyframes/image/compressed", on_keyframe, qos.reliable(50))
    scene.others.create_subscription(KeyframesRetired, "keyframes/retired", on_retired, qos.reliable(50))
    stamps = [START + index * 500_000_000 for index in range(40)]
    for index, stamp in enumerate(stamps):
        scene.show(stamp, compressed(stamp, view(wall, 20 * index)))
    finish = scene.others.create_client(Finish, "frames/finish")
    scene.spin_until(finish.service_is_ready)
    end = finish.call_async(Finish.Request(expected_inputs=len(stamps)))
    scene.spin_until(end.done)
    assert end.result().success
    assert end.result().outputs == done[0] == 10
    assert sorted(images) == [stamps[index] for index in (0, 16, 32, 36)]

    def last_word() -> set[int]:
        latest = {messages.stamp_ns(decision.header.stamp): decision.chosen for decision in scene.decisions}
        return {stamp for stamp, chosen in latest.items() if chosen}

    scene.spin_until(lambda: last_word() == images)


def test_a_viewer_is_not_taken_for_the_detector(stage: Callable[..., Stage], wall: NDArray) -> None:
    """In lockstep nothing is published before SfM and detector are there, however many viewers subscribe."""
    scene = stage("-p", "lockstep:=true")
    scene.add_node("sfm", stage=True)
    scene.add_node("rviz", stage=False)
    scene.add_node("image_view", stage=False)
    topics = ("keyframes/image/compressed", "keyframes/camera_info")
    scene.spin_until(lambda: all(scene.node.count_subscribers(topic) >= 3 for topic in topics))
    scene.show(START, compressed(START, view(wall, 0)))
    scene.spin_until(lambda: scene.decisions)
    connecting = scene.node._connecting
    scene.spin_until(lambda: connecting.time_until_next_call() < 5e7)
    scene.spin_until(lambda: connecting.time_until_next_call() > 5e7)  # it has looked once more
    assert not scene.keyframes
    assert not connecting.is_canceled()
    scene.add_node("detect", stage=True)
    scene.spin_until(lambda: scene.keyframes)


def test_in_lockstep_every_image_is_decided_on(stage: Callable[..., Stage], wall: NDArray) -> None:
    """A replay counts decisions: damaged, absurd and uncalibrated images have theirs, and the survey can end."""
    scene = stage("-p", "lockstep:=true")
    for name in ("sfm", "detect"):
        scene.add_node(name, stage=True)
    scene.others.create_subscription(
        CompressedImage,
        "keyframes/image/compressed",
        lambda message: scene.answer(messages.stamp_ns(message.header.stamp), len(scene.keyframes), []),
        qos.reliable(50),
    )
    hostile = {
        3: messages.compressed_image(START + 3 * 200_000_000, "camera", png_header(100_000, 100_000)),
        5: messages.compressed_image(START + 5 * 200_000_000, "camera", png_header(1, 1)),
        7: messages.compressed_image(START + 7 * 200_000_000, "camera", b""),
        9: compressed(START + 10**17, view(wall, 720)),
        11: compressed(START + 10 * 200_000_000, view(wall, 800)),
        13: compressed(START + 13 * 200_000_000, view(wall, 0)[:180, :320]),
    }
    hostile[15] = messages.compressed_image(0, "x" * 300, b"")
    hostile[15].header.stamp = Time(sec=2**31 - 1, nanosec=2**32 - 1)
    sent = []
    for index in range(20):
        stamp = START + index * 200_000_000
        image = hostile.get(index, compressed(stamp, view(wall, 80 * index)))
        sent.append(messages.stamp_ns(image.header.stamp))
        scene.show(sent[-1], image)
    finish = scene.others.create_client(Finish, "frames/finish")
    scene.spin_until(finish.service_is_ready)
    end = finish.call_async(Finish.Request(expected_inputs=len(sent)))
    scene.spin_until(end.done)
    scene.spin_until(lambda: len(scene.decisions) >= len(sent))
    assert end.result().success
    assert sorted(messages.stamp_ns(decision.header.stamp) for decision in scene.decisions) == sorted(sent)
    said = {messages.stamp_ns(decision.header.stamp): decision.reason for decision in scene.decisions}
    assert [said[sent[index]].partition(":")[0] for index in (3, 5, 7, 9, 11, 13, 15)] == [
        *("damaged image", "damaged image", "damaged image", "stamp jumps ahead", "stamp repeats"),
        *("size differs from CameraInfo", "damaged image"),
    ]
    assert "300 characters" in said[sent[15]]


def test_in_a_pause_images_are_passed_over_and_a_new_track_begins_afterwards(
    stage: Callable[..., Stage], wall: NDArray
) -> None:
    scene = stage()
    paused = scene.others.create_publisher(Bool, "survey/paused", qos.latched())
    for index in range(7):
        stamp = START + index * 200_000_000
        scene.show(stamp, compressed(stamp, view(wall, 30 * index)))
    paused.publish(Bool(data=True))
    scene.spin_until(lambda: scene.node._health()[1] == "the survey is paused: images are passed over")
    scene.spin_until(lambda: len(scene.decisions) == 7)  # none waits for what comes after the pause
    for index in range(7, 10):
        scene.pass_over(compressed(START + index * 200_000_000, view(wall, 30 * index)))
    assert scene._counted("frames considered") == 7
    assert scene._counted(PASSED_OVER) == 3
    paused.publish(Bool(data=False))
    scene.spin_until(lambda: scene.node._health()[1] == "selecting")
    shown = [START + (50 + index) * 200_000_000 for index in range(6)]
    for index, stamp in enumerate(shown):
        scene.show(stamp, compressed(stamp, view(wall, 4000 + 80 * index)))
    scene.spin_until(lambda: len(scene.decisions) >= 8)
    said = {messages.stamp_ns(decision.header.stamp): decision.reason for decision in scene.decisions}
    assert said[shown[0]] == "first frame"
    assert len(set(scene.chosen()) & set(shown)) >= 4
    assert not scene.retired


def test_a_node_that_is_started_anew_in_a_pause_hears_of_it(stage: Callable[..., Stage]) -> None:
    scene = stage()
    paused = scene.others.create_publisher(Bool, "survey/paused", qos.latched())
    paused.publish(Bool(data=True))
    scene.spin_until(lambda: "paused" in scene.node._health()[1])
    late = FramesNode()
    scene.host(late)
    scene.spin_until(lambda: "paused" in late._health()[1])


def test_a_survey_without_a_keyframe_ends_with_a_remedy(stage: Callable[..., Stage]) -> None:
    scene = stage()
    scene.show(START, compressed(START, np.full((360, 640), 120, np.uint8)))
    finish = scene.others.create_client(Finish, "frames/finish")
    scene.spin_until(finish.service_is_ready)
    end = finish.call_async(Finish.Request(expected_inputs=1))
    scene.spin_until(end.done)
    assert not end.result().success
    assert "are they sharp, lit and of surfaces with texture" in end.result().message


def test_a_network_takes_a_recording(stage: Callable[..., Stage]) -> None:
    with pytest.raises(InputError, match="pipeprog replay"):
        stage("-p", "policy:=network")
    rclpy.try_shutdown()
