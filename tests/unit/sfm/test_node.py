# SPDX-License-Identifier: Apache-2.0
"""The door of the sfm node: how keyframes are paired and motion is counted, whatever comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CompressedImage, Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_camera.limits import MAX_CAMERAS, MAX_UNPAIRED
from pipeprog_node import keyframe_input, messages
from pipeprog_node.intake import Intake
from pipeprog_node.keyframe_input import CALIBRATIONS, IMAGES, KeyframeInput
from pipeprog_sfm import node as sfm
from pipeprog_sfm.node import MotionInput

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
ENCODED = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()


class Topics:
    """Stands for a node: `send` calls the subscription of a topic."""

    def __init__(self) -> None:
        self._callbacks: dict[str, Callable[[Any], None]] = {}
        self.logged: list[str] = []

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], *_: Any, **__: Any) -> None:
        self._callbacks[topic] = callback

    def get_logger(self) -> Topics:
        return self

    def error(self, text: str) -> None:
        self.logged.append(text)

    def resolve_topic_name(self, topic: str) -> str:
        return topic

    def send(self, topic: str, *sent: Any) -> None:
        for message in sent:
            self._callbacks[topic](message)


class Keyframes:
    """The keyframes that the node is handed."""

    def __init__(self) -> None:
        self.topics = Topics()
        self.intake = Intake(self.topics)
        self.taken: list[tuple[int, str]] = []
        self.input = KeyframeInput(self.intake, lambda stamp, encoded, camera, frame: self.taken.append((stamp, frame)))

    def image(self, stamp: int, frame: str = "camera") -> None:
        self.topics.send(IMAGES, messages.compressed_image(stamp, frame, ENCODED))

    def calibration(self, stamp: int, frame: str = "camera") -> None:
        self.topics.send(CALIBRATIONS, messages.info_from_camera(CAMERA, stamp, frame))

    def keyframe(self, stamp: int, frame: str = "camera") -> None:
        self.image(stamp, frame)
        self.calibration(stamp, frame)


class Motion:
    """What the node is handed of a robot's motion."""

    def __init__(self) -> None:
        self.topics = Topics()
        self.intake = Intake(self.topics)
        self.input = MotionInput(self.intake, reliable=True)


@pytest.fixture
def keyframes() -> Keyframes:
    return Keyframes()


@pytest.fixture
def motion() -> Motion:
    return Motion()


def odometry(child: str = "base", w: float = 1.0) -> Odometry:
    message = Odometry(header=Header(frame_id="odom"), child_frame_id=child)
    message.pose.pose.orientation.w = w
    return message


def edge(child: str, w: float = 1.0) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id="base"), child_frame_id=child)
    message.transform.rotation.w = w
    return message


def test_a_keyframe_is_an_image_and_its_calibration_in_either_order(keyframes: Keyframes) -> None:
    keyframes.keyframe(1)
    keyframes.calibration(2)
    keyframes.image(2)
    assert keyframes.taken == [(1, "camera"), (2, "camera")]


def test_a_stamp_that_comes_twice_is_refused_by_name(keyframes: Keyframes) -> None:
    for _ in range(3):
        keyframes.keyframe(1)
    assert keyframes.taken == [(1, "camera")]
    assert keyframes.intake.health() == {f"dropped on {topic}: repeated": 2 for topic in (CALIBRATIONS, IMAGES)}
    assert "'camera' at 1 ns came twice" in keyframes.topics.logged[0]


def test_cameras_of_one_moment_are_told_apart_each_once(keyframes: Keyframes) -> None:
    for _ in range(2):
        for frame in ("left", "right"):
            keyframes.keyframe(5, frame)
    assert keyframes.taken == [(5, "left"), (6, "right")]


def test_more_cameras_of_one_moment_than_a_robot_has_are_refused(keyframes: Keyframes) -> None:
    for number in range(MAX_CAMERAS + 1):
        keyframes.keyframe(5, f"camera {number}")
    assert len(keyframes.taken) == MAX_CAMERAS
    assert keyframes.intake.health() == {f"dropped on {IMAGES}: cameras": 1}


def test_a_retired_keyframe_may_come_again(keyframes: Keyframes) -> None:
    keyframes.keyframe(1)
    keyframes.input.forget([1, 99])
    keyframes.keyframe(1)
    assert keyframes.taken == [(1, "camera")] * 2


def test_what_is_never_paired_is_bounded(keyframes: Keyframes) -> None:
    for stamp in range(MAX_UNPAIRED + 2):
        keyframes.image(stamp)
        keyframes.calibration(10_000 + stamp)
    assert keyframes.intake.health() == {f"dropped on {topic}: unpaired": 2 for topic in (CALIBRATIONS, IMAGES)}
    keyframes.calibration(0)  # its image was the oldest
    keyframes.calibration(2)
    assert keyframes.taken == [(2, "camera")]


def test_images_that_are_never_paired_are_bounded_in_bytes(
    keyframes: Keyframes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keyframe_input, "MAX_ENCODED_IMAGE", 2 * len(ENCODED))
    for stamp in range(4):
        keyframes.image(stamp)
    assert keyframes.intake.health() == {f"dropped on {IMAGES}: unpaired": 2}


def test_motion_that_cannot_be_used_is_counted_all_the_same(motion: Motion) -> None:
    motion.topics.send("odometry", odometry(), odometry(w=1e-300), odometry(child=""))
    motion.topics.send("imu", Imu(), Imu(header=Header(stamp=Time(sec=-1))))
    motion.topics.send("/tf", TFMessage(transforms=[edge("head"), edge("arm", w=0.0), edge("leg")]))
    motion.topics.send("/tf", TFMessage(transforms=[edge("head")] * 1001))
    motion.topics.send("/tf_static", TFMessage(transforms=[edge("camera")]))
    assert motion.input.considered == 3 + 2 + 3 + 1001 + 1
    taken = motion.input.take()
    assert [(each.child, each.static) for each in taken.transforms] == [
        ("camera", True),
        ("base", False),
        ("head", False),
        ("leg", False),
    ]
    assert len(taken.accelerations) == 1
    assert motion.input.take() == sfm.RobotMotion()
    assert motion.intake.health() == {
        "dropped on /tf: count": 1,
        "dropped on /tf: rotation": 1,
        "dropped on imu: stamp": 1,
        "dropped on odometry: name": 1,
        "dropped on odometry: rotation": 1,
    }


def test_motion_that_waits_for_a_keyframe_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "MAX_WAITING_MOTION", 3)
    motion = Motion()
    motion.topics.send("/tf_static", TFMessage(transforms=[edge("camera"), edge("imu"), edge("camera")]))
    for _ in range(5):
        motion.topics.send("odometry", odometry())
        motion.topics.send("imu", Imu())
    taken = motion.input.take()
    assert [each.child for each in taken.transforms] == ["camera", "imu", "base", "base", "base"]
    assert len(taken.accelerations) == 3


def test_names_of_frames_are_bounded(motion: Motion, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "MAX_TRANSFORM_FRAMES", 3)
    motion.topics.send("odometry", odometry(), odometry("another"), odometry("third"), odometry("base"))
    assert [each.child for each in motion.input.take().transforms] == ["base", "another", "base"]
    assert motion.intake.health() == {"dropped on odometry: frames": 1}


def test_a_stamp_with_compressed_bytes_that_are_no_image_is_refused(keyframes: Keyframes) -> None:
    keyframes.topics.send(IMAGES, CompressedImage(header=Header(frame_id="camera"), data=b"no image"))
    assert keyframes.intake.health() == {f"dropped on {IMAGES}: image": 1}
