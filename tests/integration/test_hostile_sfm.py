# SPDX-License-Identifier: Apache-2.0
"""The sfm node under attack, over real DDS: fuzzed messages on every subscription, then good keyframes of the demo."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Path as PathMsg
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2

from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.camera import Camera
from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.config import FusionConfig, MapperConfig, SfmConfig, StereoConfig
from pipeprog_sfm.reconstruction import MetricMap, Reconstruction
from tests.fuzz.fuzzed_messages import fuzzed_messages, good_messages

BAGS = Path(__file__).parents[2] / "bags"
BOARD = BAGS / "demo.board.yaml"
CHOSEN = slice(3, 19, 2)  # frames of the demo that show the board
TOPICS = [
    *("keyframes/image/compressed", "keyframes/camera_info", "keyframes/retired"),
    *("odometry", "imu", "/tf", "/tf_static"),
]
COUNT, SEED = 100, 5  # messages on each topic
ROUNDS = 5  # messages on each topic before all must have arrived: half the publishers' depth
TIMEOUT = 150.0  # s, for whatever takes seconds on an idle machine
CONFIG = SfmConfig(
    mapper=MapperConfig(max_features=1500), stereo=StereoConfig(width=320), fusion=FusionConfig(voxel=0.01)
)
PARAMETERS = {
    "board": BOARD,
    "lockstep": "true",  # no message may be lost, and a worker that dies ends the node
    "mapper.max_features": CONFIG.mapper.max_features,
    "stereo.width": CONFIG.stereo.width,
    "fusion.voxel": CONFIG.fusion.voxel,
}


@lru_cache
def keyframes() -> list[tuple[int, bytes, Camera]]:
    """Stamp, JPEG and camera of keyframes at half the demo's resolution, which takes a quarter of the time."""
    found = []
    for frame in list(Bag.open(BAGS / "demo.mcap"))[CHOSEN]:
        image = cv2.imdecode(np.frombuffer(deserialize_message(frame.data, CompressedImage).data, np.uint8), 1)
        camera = messages.camera_from_info(deserialize_message(frame.camera_info, CameraInfo)).scaled(0.5)
        half = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        found.append((frame.stamp, messages.encode_jpeg(half), camera))
    return found


def undisturbed() -> MetricMap:
    """The map of the same keyframes without an attack."""
    reconstruction = Reconstruction(CONFIG, load_board_file(str(BOARD)))
    for stamp, encoded, camera in keyframes():
        reconstruction.add(stamp, encoded, camera, "camera_optical")
        reconstruction.update_dense()
    return reconstruction.finish()


class Peer:
    """Publishes to the node, and notes what it answers."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.node = Node("peer")
        self.answered: set[int] = set()
        self.health = DiagnosticStatus()
        self.points, self.poses = PointCloud2(), PathMsg()
        self._process = process
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._publishers = {
            topic: self.node.create_publisher(type(good_messages(0)[topic]), topic, qos.kept(2 * ROUNDS))
            for topic in TOPICS
        }
        subscribe = self.node.create_subscription
        subscribe(msg.ImageOverlapArray, "image_overlap", self._on_overlap, qos.kept(50))
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        subscribe(PointCloud2, "map_points", self._on_points, qos.latched())
        subscribe(PathMsg, "keyframe_poses", self._on_poses, qos.latched())
        self._finish = self.node.create_client(srv.Finish, "sfm/finish")

    def wait_for(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert self._process.poll() is None, "the node has ended"
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.1)

    def is_connected(self) -> bool:
        heard = all(publisher.get_subscription_count() for publisher in self._publishers.values())
        return heard and bool(self.health.name) and self._finish.service_is_ready()

    def publish(self, topic: str, content: Any) -> None:
        self._publishers[topic].publish(content)

    def settle(self) -> None:
        for publisher in self._publishers.values():
            assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))

    def dropped(self) -> dict[str, int]:
        """Messages dropped by topic and kind."""
        start = "dropped on "
        return {each.key[len(start) :]: int(each.value) for each in self.health.values if each.key.startswith(start)}

    def finish(self) -> srv.Finish.Response:
        answer = self._finish.call_async(srv.Finish.Request(expected_inputs=len(keyframes())))
        self.wait_for(answer.done)
        return answer.result()

    def _on_overlap(self, message: msg.ImageOverlapArray) -> None:
        self.answered.add(messages.stamp_ns(message.header.stamp))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.health = message.status[0]

    def _on_points(self, message: PointCloud2) -> None:
        self.points = message

    def _on_poses(self, message: PathMsg) -> None:
        self.poses = message


@pytest.fixture
def peer() -> Iterator[Peer]:
    parameters = [word for name, value in PARAMETERS.items() for word in ("-p", f"{name}:={value}")]
    process = subprocess.Popen([sys.executable, "-m", "pipeprog_sfm.node", "--ros-args", *parameters])
    rclpy.init()
    peer = Peer(process)
    yield peer
    peer.node.destroy_node()
    rclpy.shutdown()
    process.kill()
    process.wait()


def test_hostile_messages_leave_the_map_as_it_would_be(peer: Peer) -> None:
    peer.wait_for(peer.is_connected)
    streams = {topic: fuzzed_messages(topic, COUNT, SEED) for topic in TOPICS}
    for number in range(COUNT):
        for topic, fuzzed in streams.items():
            peer.publish(topic, fuzzed[number].content)
        if number % ROUNDS == ROUNDS - 1:
            peer.settle()
    for stamp, encoded, camera in keyframes():
        peer.publish(TOPICS[0], messages.compressed_image(stamp, "camera_optical", encoded))
        peer.publish(TOPICS[1], messages.info_from_camera(camera, stamp, "camera_optical"))
        peer.wait_for(partial(peer.answered.__contains__, stamp))
    answer = peer.finish()
    assert answer.success, answer.message
    peer.wait_for(lambda: peer.points.width and peer.points.header == peer.poses.header)

    # Each topic has had messages that could not be used, of several kinds.
    peer.wait_for(lambda: peer.health.level != DiagnosticStatus.OK)
    assert {key.partition(":")[0] for key in peer.dropped()} == set(TOPICS)
    assert len(peer.dropped()) > 2 * len(TOPICS)

    expected = undisturbed()
    stamps, poses = messages.poses_from_path(peer.poses)
    assert set(expected.trajectory.stamps) <= set(stamps)
    places = dict(zip(stamps.tolist(), poses[:, :3, 3], strict=True))
    for stamp, pose in zip(expected.trajectory.stamps.tolist(), expected.trajectory.map_from_camera, strict=True):
        assert np.linalg.norm(places[stamp] - pose[:3, 3]) < 0.002  # m, a thousandth of the distance to the board
    assert peer.points.width == pytest.approx(len(expected.cloud.points), rel=0.02)

    # Whoever asks once more, for the answer was lost, gets the same map, not another one to be measured anew.
    again = peer.finish()
    assert (again.success, again.outputs) == (True, answer.outputs)
    peer.publish(TOPICS[0], messages.compressed_image(stamp + 1, "camera_optical", encoded))
    peer.publish(TOPICS[1], messages.info_from_camera(camera, stamp + 1, "camera_optical"))
    peer.wait_for(partial(peer.answered.__contains__, stamp + 1))
    assert peer.finish().outputs > answer.outputs
