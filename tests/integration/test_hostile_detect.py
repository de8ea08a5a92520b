# SPDX-License-Identifier: Apache-2.0
"""Hostile messages on every topic of the detector, over DDS; then a good map, whose pipes come as without them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as Poses
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2

from pipeprog_camera.camera import Camera
from pipeprog_detect.config import ContourConfig, DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.types import Cloud
from pipeprog_msgs import msg
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos
from tests.fuzz.fuzzed_messages import fuzzed_messages

COUNT = 150  # messages for each topic
TIMEOUT = 120.0  # s
STAMPS = [1_700_000_000_000_000_000 + number * 200_000_000 for number in range(3)]
REVISION = 100_000  # the largest that a status may have: later than every hostile one
CAMERA = Camera(640, 360, 450.0, 450.0, 319.5, 179.5)
BOQ = "classes:\n  - {name: DN100, outer_radius_mm: 57.5, planned_length_m: 4.0}\n"
TOPICS = {
    "keyframes/image/compressed": (CompressedImage, qos.reliable(50)),
    "keyframes/camera_info": (CameraInfo, qos.reliable(50)),
    "map_points": (PointCloud2, qos.latched()),
    "keyframe_poses": (Poses, qos.latched()),
    "sfm_status": (msg.SfmStatus, qos.latched()),
}


class Others:
    """What the selector, the SfM and an adversary send to the node, and what it answers."""

    def __init__(self) -> None:
        self.node = Node("others")
        self.pipes: list[msg.PipeArray] = []
        self.values: dict[str, str] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, profile) for topic, (kind, profile) in TOPICS.items()
        }
        self.finish = self.node.create_client(Finish, "detect/finish")
        self.node.create_subscription(msg.PipeArray, "pipes", self.pipes.append, qos.latched())
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def wait_for(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain; the node says {self.values}"
            self._executor.spin_once(timeout_sec=0.1)

    def publish(self, topic: str, message: object) -> None:
        self.publishers[topic].publish(message)

    def is_connected(self) -> bool:
        heard = all(publisher.get_subscription_count() for publisher in self.publishers.values())
        return heard and self.finish.service_is_ready() and bool(self.values)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.values = {pair.key: pair.value for status in message.status for pair in status.values}


@pytest.fixture
def others() -> Iterator[Others]:
    rclpy.init()
    others = Others()
    yield others
    others.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def node(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    boq = tmp_path / "boq.yaml"
    boq.write_text(BOQ)
    arguments = ["--ros-args", "--log-level", "fatal", "-p", f"boq:={boq}", "-p", "contour.enabled:=false"]
    process = subprocess.Popen([sys.executable, "-m", "pipeprog_detect.node", *arguments])
    yield process
    process.kill()
    process.wait()


def barrel() -> np.ndarray:
    """Points (N, 3) float32 on the front of a pipe of 57.5 mm radius, a metre long."""
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(-1.3, 1.3, 6000), rng.uniform(0.0, 1.0, 6000)
    radius = 0.0575 + rng.normal(0.0, 5e-4, 6000)
    return np.c_[along, -np.cos(angle) * radius, np.sin(angle) * radius].astype(np.float32)


def send_survey(others: Others, points: np.ndarray) -> None:
    encoded = cv2.imencode(".jpg", np.full((360, 640), 128, np.uint8))[1].tobytes()
    for stamp in STAMPS:
        others.publish("keyframes/image/compressed", messages.compressed_image(stamp, "camera", encoded))
        others.publish("keyframes/camera_info", messages.info_from_camera(CAMERA, stamp, "camera"))
    header = messages.header(STAMPS[-1], "map")
    status = msg.SfmStatus(map_revision=REVISION, map_stamp=header.stamp, scale_source="board", scale_sigma=0.001)
    others.publish("map_points", messages.point_cloud(header, points))
    others.publish("keyframe_poses", messages.path(header, np.array(STAMPS), np.tile(np.eye(4), (3, 1, 1))))
    others.publish("sfm_status", status)


def test_hostile_messages_and_a_killed_worker_change_no_pipe(
    others: Others, node: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    others.wait_for(others.is_connected)
    for streams in zip(*(fuzzed_messages(topic, COUNT, seed=1) for topic in TOPICS), strict=True):
        for topic, fuzzed in zip(TOPICS, streams, strict=True):
            others.publish(topic, fuzzed.content)
    others.wait_for(lambda: any(key.startswith("dropped on") for key in others.values))
    children = Path(f"/proc/{node.pid}/task/{node.pid}/children").read_text().split()
    worker = next(int(one) for one in children if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes())
    os.kill(worker, signal.SIGKILL)
    end = others.finish.call_async(Finish.Request(expected_inputs=REVISION))
    points = barrel()
    send_survey(others, points)
    others.wait_for(end.done)
    assert end.result().success, end.result().message
    others.wait_for(lambda: others.pipes and others.pipes[-1].map_revision == REVISION)
    assert node.poll() is None

    boq = load_boq(tmp_path / "boq.yaml")
    (expected,) = detect(Cloud(points.astype(float)), boq, DetectConfig(contour=ContourConfig(False)))
    (found,) = others.pipes[-1].pipes
    assert (found.radius, found.class_name, found.points) == (
        expected.cylinder.radius,
        expected.class_name,
        expected.points,
    )
    assert [found.start.x, found.start.y, found.start.z] == expected.cylinder.start.tolist()
