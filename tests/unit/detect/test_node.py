# SPDX-License-Identifier: Apache-2.0
"""The detector's node between keyframes, maps and those who read `pipes`; its worker is the real one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Path as Poses
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_bringup.playback.survey_writer import product_from_msg
from pipeprog_bringup.results.result_files import Scale, write_pipes
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_detect.config import ContourConfig, DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.node import PATIENCE, TICK, DetectNode
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.product import Product, product_of
from pipeprog_detect.types import Cloud
from pipeprog_msgs import msg
from pipeprog_msgs.srv import Finish
from pipeprog_node import messages, qos

CAMERA = Camera(640, 360, 450.0, 450.0, 319.5, 179.5)
START = 1_700_000_000_000_000_000
STEP = 200_000_000
SETTINGS = ("-p", "contour.enabled:=false")  # the images of these tests show nothing
JPEG = cv2.imencode(".jpg", np.full((360, 640), 128, np.uint8))[1].tobytes()
SMALLER = cv2.imencode(".jpg", np.full((180, 320), 128, np.uint8))[1].tobytes()
BOQ = """classes:
  - {name: DN100, outer_radius_mm: 57.5, planned_length_m: 4.0, color: "#ff0000"}
  - {name: DN50, outer_radius_mm: 30.2, planned_length_m: 2.0}
"""


def corner() -> FloatArray:
    """Points (N, 3) float32 of two pipes of 57.5 mm radius with an elbow between them, and of one of 40 mm."""
    rng = np.random.default_rng(0)
    barrels = []
    for start, end, radius in (
        ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.0575),
        ([1.15, 0.0, 0.15], [1.15, 0.0, 0.9], 0.0575),
        ([0.0, 0.0, 0.6], [0.8, 0.0, 0.6], 0.04),
    ):
        axis = np.subtract(end, start)
        count = int(100_000 * radius * np.linalg.norm(axis))
        front = np.array([0.0, -1.0, 0.0])
        side = np.cross(front, axis / np.linalg.norm(axis))
        angle = rng.uniform(-1.3, 1.3, (count, 1))
        across = np.cos(angle) * front + np.sin(angle) * side
        barrels.append(start + rng.uniform(0, 1, (count, 1)) * axis + rng.normal(radius, 5e-4, (count, 1)) * across)
    return np.concatenate(barrels).astype(np.float32)


class Stage:
    """The node under test; what the selector and the SfM send it, and what it says."""

    def __init__(self, boq: Path, *arguments: str) -> None:
        self.boq = boq
        boq.write_text(BOQ)
        parameters = ("-p", f"boq:={boq}", *SETTINGS, *arguments)
        rclpy.init(args=["--ros-args", "--log-level", "fatal", *parameters])
        self.node = DetectNode()
        self.others = Node("others")
        self.pipes: list[msg.PipeArray] = []
        self.markers: list[MarkerArray] = []
        self.health: list[DiagnosticStatus] = []
        self.others.create_subscription(msg.PipeArray, "pipes", self.pipes.append, qos.latched())
        self.others.create_subscription(MarkerArray, "pipe_markers", self.markers.append, qos.latched())
        self.others.create_subscription(
            DiagnosticArray, "/diagnostics", lambda message: self.health.extend(message.status), 10
        )
        publish = self.others.create_publisher
        self._images = publish(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._infos = publish(CameraInfo, "keyframes/camera_info", qos.reliable(50))
        self._points = publish(PointCloud2, "map_points", qos.latched())
        self._poses = publish(Poses, "keyframe_poses", qos.latched())
        self._velocities = publish(msg.KeyframeVelocities, "keyframe_velocities", qos.latched())
        self._status = publish(msg.SfmStatus, "sfm_status", qos.latched())
        self._executor = SingleThreadedExecutor()
        for node in (self.node, self.others):
            self._executor.add_node(node)
        topics = (self._images, self._infos, self._points, self._poses, self._velocities, self._status)
        self.spin_until(
            lambda: (
                all(topic.get_subscription_count() for topic in topics)
                and self.others.count_publishers("pipes")
                and self.others.count_publishers("pipe_markers")
            )
        )

    def close(self) -> None:
        self._executor.shutdown()
        for node in (self.node, self.others):
            node.destroy_node()
        rclpy.try_shutdown()

    def spin_until(self, condition: Callable[[], object], seconds: float = 60.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=0.02)

    def send_image(self, stamp: int, encoded: bytes = JPEG) -> None:
        self._images.publish(messages.compressed_image(stamp, "camera", encoded))

    def send_calibration(self, stamp: int, focal_length: float = CAMERA.fx) -> None:
        info = messages.info_from_camera(CAMERA, stamp, "camera")
        info.k[0] = focal_length
        self._infos.publish(info)

    def send_map(
        self,
        stamp: int,
        revision: int,
        keyframes: list[int],
        points: FloatArray,
        readout: float = 0.0,
        final: bool = False,
    ) -> None:
        header = messages.header(stamp, "map")
        self._points.publish(messages.point_cloud(header, points, np.zeros((len(points), 3), np.uint8)))
        self._poses.publish(messages.path(header, np.array(keyframes), np.tile(np.eye(4), (len(keyframes), 1, 1))))
        status = msg.SfmStatus(map_revision=revision, scale_source="board", scale_sigma=0.0004)
        status.map_stamp = messages.time_msg(stamp)
        status.readout, status.map_final = readout, final
        self._status.publish(status)

    def send_velocities(self, stamp: int, readout: float, linear: FloatArray) -> None:
        header = messages.header(stamp, "map")
        self._velocities.publish(messages.keyframe_velocities(header, readout, linear, *np.zeros((3, *linear.shape))))

    def values(self) -> dict[str, str]:
        """What the next diagnostics say, by key; the message under an empty one."""
        self.health.clear()
        self.spin_until(lambda: self.health)
        status = self.health[-1]
        return {"": status.message, **{pair.key: pair.value for pair in status.values}}


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Callable[..., Stage]]:
    stages = []

    def make(*arguments: str) -> Stage:
        stages.append(Stage(tmp_path / "boq.yaml", *arguments))
        return stages[-1]

    yield make
    for each in stages:
        each.close()


def test_what_a_robot_is_told_is_what_the_files_hold(stage: Callable[..., Stage], tmp_path: Path) -> None:
    scene, points = stage(), corner()
    scene.send_map(START, 7, [], points)
    scene.spin_until(lambda: scene.pipes and scene.markers)
    (message,) = scene.pipes
    assert (message.header.frame_id, messages.stamp_ns(message.header.stamp)) == ("map", START)
    assert (message.map_revision, message.scale_source, message.scale_sigma) == (7, "board", 0.0004)

    boq = load_boq(scene.boq)
    pipes = detect(Cloud(points.astype(float)), boq, DetectConfig(contour=ContourConfig(False)))
    found = product_of(pipes, boq, message.scale_sigma)
    assert len(found.pipes) == 3

    def file(product: Product) -> str:
        write_pipes(tmp_path / "pipes.json", product, Scale("board", 0.0004))
        return (tmp_path / "pipes.json").read_text()

    assert file(product_from_msg(message)) == file(found)
    assert sorted(pipe.class_name for pipe in message.pipes) == ["", "DN100", "DN100"]
    assert sorted(pipe.class_kmeans for pipe in message.pipes) == ["DN100", "DN100", "DN50"]
    joined, alone = sorted(message.runs, key=lambda run: -len(run.pipes))
    assert {run.id for run in message.runs} == {"r01", "r02"}
    assert {pipe.id for pipe in message.pipes if pipe.class_name} == set(joined.pipes)
    (joint,) = joined.joints
    assert (joint.kind, set(joint.pipes)) == ("elbow", set(joined.pipes))
    assert joint.angle == pytest.approx(np.pi / 2, abs=0.02)
    assert joined.centre_line_length == pytest.approx(joined.barrel_length + joint.length)
    assert (len(alone.pipes), alone.joints) == (1, [])
    assert [row.class_name for row in message.classes] == ["DN100", "DN50"]
    assert message.classes[0].color.r == 1.0

    (markers,) = scene.markers
    assert markers.markers[0].action == Marker.DELETEALL
    assert len(markers.markers) == 1 + 2 * len(message.pipes)


def test_a_map_waits_for_its_keyframes(stage: Callable[..., Stage]) -> None:
    """Image and calibration of a keyframe come in either order, and after the map, too."""
    scene, stamps = stage(), [START, START + STEP]
    scene.send_map(START, 1, stamps, corner())
    scene.send_image(stamps[0])
    scene.send_calibration(stamps[1])
    scene.send_image(stamps[1])
    scene.spin_until(lambda: scene.values()["keyframes"] == "1")
    assert scene.values()["map revision"] == "0"
    scene.send_calibration(stamps[0])
    scene.spin_until(lambda: scene.pipes)
    assert scene.values()["keyframes"] == "2"
    assert scene.values()["pipes"] == "3"


@pytest.mark.parametrize(("silence", "begun"), [(0.1, 1), (1.0, 2), (PATIENCE * TICK, 1)])
def test_a_map_without_the_newest_keyframes_is_not_begun_where_another_follows(
    stage: Callable[..., Stage], monkeypatch: pytest.MonkeyPatch, silence: float, begun: int
) -> None:
    """Once no keyframe comes any more, one of all follows, but for the last ones: there may be no pose for them."""
    now = 0.0
    monkeypatch.setattr("pipeprog_detect.node.monotonic", lambda: now)
    scene, stamps = stage(), [START + number * STEP for number in range(6)]
    for stamp in stamps:
        scene.send_image(stamp)
        scene.send_calibration(stamp)
    scene.spin_until(lambda: scene.values()["keyframes"] == "6")
    now = silence
    scene.send_map(stamps[2], 1, stamps[:3], corner())
    if begun == 2:
        assert [scene.values()["map revision"] for _ in range(2)] == ["0", "0"]
        scene.send_map(stamps[3], 2, stamps[:4], corner())
    scene.spin_until(lambda: scene.pipes)
    assert scene.pipes[0].map_revision == begun


def test_a_map_of_a_rolling_shutter_waits_for_its_velocities(stage: Callable[..., Stage]) -> None:
    """What no camera does is refused, and the map goes on waiting; as many velocities as poses make it whole."""
    scene, stamps = stage(), [START, START + STEP]
    for stamp in stamps:
        scene.send_image(stamp)
        scene.send_calibration(stamp)
    scene.send_map(START, 1, stamps, corner(), readout=0.015)
    scene.send_velocities(START, 1.0, np.zeros((2, 3)))
    scene.spin_until(lambda: scene.values().get("dropped on keyframe_velocities: read-out") == "1")
    scene.send_velocities(START, 0.015, np.full((2, 3), np.nan))
    scene.spin_until(lambda: scene.values().get("dropped on keyframe_velocities: velocities") == "1")
    assert scene.values()["map revision"] == "0"
    scene.send_velocities(START, 0.015, np.array([[0.75, 0.0, 0.0], [0.7, 0.0, 0.1]]))
    scene.spin_until(lambda: scene.pipes)
    assert len(scene.pipes[0].pipes) == 3


def test_velocities_of_other_keyframes_are_refused(stage: Callable[..., Stage]) -> None:
    scene = stage()
    scene.send_velocities(START, 0.015, np.zeros((3, 3)))
    scene.send_map(START, 1, [], corner(), readout=0.015)
    scene.spin_until(lambda: scene.values().get("dropped on keyframe_velocities: no detection") == "1")
    assert not scene.pipes


def test_a_wrong_calibration_ends_no_node_and_stops_no_map(stage: Callable[..., Stage]) -> None:
    scene, stamps = stage(), [START, START + STEP, START + 2 * STEP]
    scene.send_calibration(stamps[0], focal_length=0.0)
    scene.send_image(stamps[0])
    scene.send_image(stamps[1])
    scene.send_calibration(stamps[1], focal_length=float("nan"))
    scene.spin_until(lambda: scene.values()["keyframes left out"] == "2")
    assert scene.values()["dropped on keyframes/camera_info: calibration"] == "2"
    assert "left out" in scene.values()[""]
    scene.send_image(stamps[2])
    scene.send_calibration(stamps[2])
    scene.send_map(START, 1, stamps, corner())
    scene.spin_until(lambda: scene.pipes)
    assert len(scene.pipes[0].pipes) == 3
    assert scene.values()["keyframes"] == "1"


def test_the_end_of_a_survey_waits_for_the_last_map(stage: Callable[..., Stage]) -> None:
    """Without intermediate results only the map that `finish` names is worked off."""
    scene = stage("-p", "intermediate:=false")
    scene.send_map(START, 1, [], corner())
    finish = scene.others.create_client(Finish, "detect/finish")
    scene.spin_until(finish.service_is_ready)
    end = finish.call_async(Finish.Request(expected_inputs=2))
    scene.spin_until(lambda: scene.values()["map revision"] == "0")
    assert not end.done()
    scene.send_map(START + STEP, 2, [], corner())
    scene.spin_until(end.done)
    assert end.result().success
    assert end.result().outputs == 2
    scene.spin_until(lambda: scene.pipes)
    assert [message.map_revision for message in scene.pipes] == [2]


def test_a_final_map_is_one_before_anybody_asks_for_the_end(stage: Callable[..., Stage]) -> None:
    """Names of its pipes follow from their places, though it comes before the request and after a map of one pipe."""
    scene, points = stage(), corner()
    scene.send_map(START, 1, [], points[points[:, 0] > 1.1])
    scene.spin_until(lambda: scene.pipes)
    (earlier,) = scene.pipes[0].pipes
    scene.send_map(START + STEP, 2, [], points, final=True)
    scene.spin_until(lambda: len(scene.pipes) > 1)
    names = [pipe.id for pipe in sorted(scene.pipes[1].pipes, key=lambda pipe: pipe.end.x)]
    assert (earlier.id, names) == ("p01", ["p02", "p01", "p03"])


def test_keyframes_that_are_no_images_are_left_out(stage: Callable[..., Stage]) -> None:
    scene, broken = stage(), [b"", b"no image", JPEG[:400], SMALLER]
    stamps = [START + number * STEP for number in range(len(broken))]
    for stamp, encoded in zip(stamps, broken, strict=True):
        scene.send_image(stamp, encoded)
        scene.send_calibration(stamp)
    scene.send_map(START, 1, stamps, corner())
    scene.spin_until(lambda: scene.pipes)
    assert len(scene.pipes[0].pipes) == 3
    assert scene.values()["keyframes left out"] == str(len(broken))


def test_a_retired_keyframe_is_forgotten_and_may_come_again(stage: Callable[..., Stage]) -> None:
    scene = stage()
    retired = scene.others.create_publisher(msg.KeyframesRetired, "keyframes/retired", qos.reliable(50))
    scene.spin_until(retired.get_subscription_count)
    again = msg.KeyframesRetired(
        header=messages.header(START, "camera"), keyframes_published=2, stamps=[messages.time_msg(START)]
    )
    retired.publish(again)  # for two keyframes, of which none has come
    for stamp, encoded in ((START, JPEG[:400]), (START + STEP, JPEG)):
        scene.send_image(stamp, encoded)
        scene.send_calibration(stamp)
    scene.spin_until(lambda: scene.values()["keyframes retired"] == "1")
    scene.send_map(START, 1, [START, START + STEP], corner())
    scene.spin_until(lambda: scene.pipes)
    assert scene.values()["keyframes left out"] == "0"  # it was not decoded
    scene.send_image(START)
    scene.send_calibration(START)
    scene.send_map(START + STEP, 2, [START, START + STEP], corner())
    scene.spin_until(lambda: len(scene.pipes) > 1)
    values = scene.values()
    assert (values["keyframes"], values[""]) == ("2", "detecting")


def test_an_image_that_never_comes_is_not_waited_for_for_ever(stage: Callable[..., Stage]) -> None:
    scene = stage()
    scene.send_map(START, 1, [START], corner())
    scene.spin_until(lambda: scene.pipes)
    assert scene.values()["dropped on keyframe_poses: no image"] == "1"


def test_a_keyframe_from_before_this_node_was_there_is_not_waited_for(stage: Callable[..., Stage]) -> None:
    """Topics keep their order: once a later one has come, there is no point in being patient."""
    scene = stage()
    scene.node._timer.cancel()
    scene.send_image(START + STEP)
    scene.send_calibration(START + STEP)
    scene.spin_until(lambda: scene.node._numbers)
    scene.send_map(START, 1, [START, START + STEP], corner())
    scene.spin_until(lambda: scene.pipes)
    assert scene.values()["dropped on keyframe_poses: no image"] == "1"


def test_a_worker_that_is_killed_loses_nothing(stage: Callable[..., Stage]) -> None:
    """The next one has the keyframes, gives the same names, and makes the map that was in work."""
    scene = stage()
    scene.send_image(START)
    scene.send_calibration(START)
    scene.send_map(START, 1, [START], corner())
    scene.spin_until(lambda: scene.pipes)
    kill_worker()
    scene.send_map(START + STEP, 2, [START], corner()[::-1].copy())
    scene.spin_until(lambda: len(scene.pipes) > 1)
    first, second = (
        {pipe.id: np.round([pipe.start.x, pipe.start.y, pipe.start.z], 2).tolist() for pipe in message.pipes}
        for message in scene.pipes
    )
    assert first == second
    assert scene.values()["worker restarts"] == "1"


def test_a_map_that_kills_is_tried_twice_and_not_when_it_comes_again(stage: Callable[..., Stage]) -> None:
    scene = stage("-p", "intermediate:=false")
    finish = scene.others.create_client(Finish, "detect/finish")
    scene.spin_until(finish.service_is_ready)
    end = finish.call_async(Finish.Request(expected_inputs=1))
    points = corner()
    dense = np.concatenate([points + np.float32(shift) for shift in np.linspace(0.0, 1e-3, 30)])  # to be killed in time
    scene.send_map(START, 1, [], dense)
    for _ in range(2):
        scene.spin_until(lambda: scene.node._in_work is not None and scene.node._supervision.is_ready)
        deaths = scene.node._supervision.deaths
        kill_worker()
        scene.spin_until(lambda: scene.node._supervision.deaths > deaths)  # noqa: B023  # within this turn
    scene.spin_until(end.done)
    assert not end.result().success
    assert "died" in end.result().message
    end = finish.call_async(Finish.Request(expected_inputs=1))
    scene.send_map(START, 1, [], dense)  # as a latched topic does
    scene.spin_until(end.done)
    assert "not tried again" in end.result().message
    end = finish.call_async(Finish.Request(expected_inputs=2))
    scene.send_map(START + STEP, 2, [], points)
    scene.spin_until(end.done)
    assert end.result().success


def kill_worker() -> None:
    """Kills the child of this process that detects."""
    (child,) = [child for child in multiprocessing.active_children() if child.is_alive()]
    assert child.pid is not None
    os.kill(child.pid, signal.SIGKILL)


def test_without_a_bill_of_quantities_there_is_no_detector() -> None:
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    try:
        with pytest.raises(InputError, match="parameter boq"):
            DetectNode()
    finally:
        rclpy.try_shutdown()
