# SPDX-License-Identifier: Apache-2.0
"""The death of a worker: its node starts another one, which has all that the first one had."""

from __future__ import annotations

import contextlib
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
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.processes.supervision import MAX_VAIN_DEATHS

TIMEOUT = 150.0  # s: the first start compiles
WIDTH, HEIGHT = 480, 320
CAMERA = Camera(WIDTH, HEIGHT, 420.0, 420.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
STEP = 36  # px between two views of a wall


class Walk:
    """Publishes keyframes along a wall, and notes what the node answers."""

    def __init__(self) -> None:
        self.node = Node("walk")
        self.status = msg.SfmStatus()
        self.considered = self.sent = 0
        self.found = False
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        wall = np.random.default_rng(1).integers(0, 256, (HEIGHT // 4, WIDTH), np.uint8)
        self._wall = cv2.resize(wall, (4 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        self._images = self.node.create_publisher(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._infos = self.node.create_publisher(CameraInfo, "keyframes/camera_info", qos.reliable(50))
        self.node.create_subscription(msg.ImageOverlapArray, "image_overlap", self._on_overlap, qos.kept(50))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.node.create_subscription(msg.SfmStatus, "sfm_status", self._on_status, qos.latched())

    def go(self, count: int) -> None:
        for _ in range(count):
            view = np.ascontiguousarray(self._wall[:, self.sent * STEP :][:, :WIDTH])
            self.sent += 1
            stamp = self.sent * 1_000_000_000
            self._images.publish(messages.compressed_image(stamp, "camera", cv2.imencode(".png", view)[1].tobytes()))
            self._infos.publish(messages.info_from_camera(CAMERA, stamp, "camera"))

    def wait_for(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.1)

    def is_connected(self) -> bool:
        heard = min(self._images.get_subscription_count(), self._infos.get_subscription_count())
        # The node answers only whom it has found, too: its first diagnostics have come.
        return heard > 0 and self.node.count_publishers("image_overlap") > 0 and self.found

    def _on_overlap(self, message: msg.ImageOverlapArray) -> None:
        self.considered = message.keyframes_considered

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.found = True

    def _on_status(self, message: msg.SfmStatus) -> None:
        self.status = message


@pytest.fixture
def walk() -> Iterator[Walk]:
    rclpy.init()
    walk = Walk()
    yield walk
    walk.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def sfm(request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "pipeprog_sfm.node", "--ros-args", "-p", f"lockstep:={request.param}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.communicate()


def worker(process: subprocess.Popen[str]) -> int:
    """The child that works: the other one keeps the books of multiprocessing."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return next(int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes())


@pytest.mark.parametrize("sfm", ["false", "true"], indirect=True)
def test_a_reconstruction_goes_on_after_the_death_of_its_process(walk: Walk, sfm: subprocess.Popen[str]) -> None:
    walk.wait_for(walk.is_connected)
    walk.go(5)
    walk.wait_for(lambda: walk.considered == 5)
    walk.wait_for(lambda: walk.status.keyframes_registered == 5)
    first = worker(sfm)
    os.kill(first, signal.SIGKILL)
    walk.go(2)
    walk.wait_for(lambda: walk.considered == 7)
    walk.wait_for(lambda: walk.status.keyframes_registered == 7)
    assert sfm.poll() is None
    assert worker(sfm) != first


@pytest.mark.parametrize("sfm", ["true"], indirect=True)
def test_the_status_counts_messages_of_motion_before_any_keyframe(walk: Walk, sfm: subprocess.Popen[str]) -> None:
    motion = {
        walk.node.create_publisher(Odometry, "odometry", qos.reliable(10)): Odometry(),
        walk.node.create_publisher(Imu, "imu", qos.reliable(10)): Imu(),
        walk.node.create_publisher(TFMessage, "/tf", qos.reliable(10)): TFMessage(transforms=2 * [TransformStamped()]),
        walk.node.create_publisher(TFMessage, "/tf_static", qos.kept(10)): TFMessage(transforms=[TransformStamped()]),
    }
    walk.wait_for(walk.is_connected)
    walk.wait_for(lambda: all(publisher.get_subscription_count() for publisher in motion))
    for publisher, message in motion.items():
        publisher.publish(message)
    walk.wait_for(lambda: walk.status.motion_considered == 5)  # one of TF counts once for each of its transforms
    assert walk.status.keyframes_seen == 0


@pytest.mark.parametrize("sfm", ["true"], indirect=True)
def test_a_replay_whose_reconstruction_dies_again_and_again_ends_and_says_why(
    walk: Walk, sfm: subprocess.Popen[str]
) -> None:
    walk.wait_for(walk.is_connected)
    killed = 0
    while sfm.poll() is None:
        with contextlib.suppress(StopIteration, OSError):  # the next one is not there yet, or the node ended
            if (child := worker(sfm)) != killed:
                os.kill(child, signal.SIGKILL)
                killed = child
    _, said = sfm.communicate(timeout=5.0)
    assert sfm.returncode == 1
    assert f"the reconstruction process died {MAX_VAIN_DEATHS + 1} times" in said
    assert "the map is lost" in said
