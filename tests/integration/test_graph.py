# SPDX-License-Identifier: Apache-2.0
"""The whole graph, real nodes over real DDS, on the first board of the demo recording: replayed and live."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag, ImageMessage
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_node import messages, qos
from tests.schemas import faults_of_pipes

BAGS = Path(__file__).parents[2] / "bags"
BAG, BOQ, BOARD = (BAGS / f"demo.{end}" for end in ("mcap", "boq.yaml", "board.yaml"))
BOARD_SEEN = slice(3, 19)  # frames from the first that shows the whole board
NO_BOARD_SEEN = slice(16, 24)
COARSE = {"stereo.width": 640, "fusion.voxel": 0.006}  # the graph is tested here, not its accuracy
TIMEOUT = 120.0  # s, for whatever takes seconds on an idle machine
DISTURBED = 77  # ROS domain in which a foreign node publishes
LOOPBACK = "0100007F"  # 127.0.0.1 in /proc/net
MODULES = {"frames": "pipeprog_frames.node", "sfm": "pipeprog_sfm.node", "detect": "pipeprog_detect.node"}


def wait_for(
    condition: Callable[[], object], pause: Callable[[float], object] = time.sleep, seconds: float = TIMEOUT
) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        pause(0.05)


def cut(path: Path, part: slice) -> Path:
    with path.open("wb") as stream, BagWriter(stream) as writer:
        for frame in list(Bag.open(BAG))[part]:
            writer.write("/camera/camera_info", cdr.CAMERA_INFO, frame.camera_info, frame.stamp)
            writer.write("/camera/image/compressed", cdr.COMPRESSED_IMAGE, frame.data, frame.stamp)
    return path


def start_replay(bag: Path, out: Path, *options: str, domain: int = 0) -> subprocess.Popen[str]:
    """The installed command; its user has set ROS_DOMAIN_ID."""
    settings = [word for name, value in COARSE.items() for word in ("--set", f"sfm.{name}={value}")]
    return subprocess.Popen(
        [Path(sys.executable).parent / "pipeprog", "replay", bag, "--boq", BOQ, "--out", out, *settings, *options],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@contextlib.contextmanager
def foreign_node(domain: int, found: Path) -> Iterator[None]:
    """A node that disturbs whatever it reaches on this machine in a domain; `found` gets the names that it sees."""
    private = ("FASTRTPS_DEFAULT_PROFILES_FILE", "SKIP_DEFAULT_XML_FILE")
    environment = {name: value for name, value in os.environ.items() if name not in private}
    environment |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(BAGS.parent), os.environ.get("PYTHONPATH", "")]))
    process = subprocess.Popen([sys.executable, "-m", "tests.integration.foreign_node", found], env=environment)
    try:
        wait_for(found.exists)
        yield
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


def addresses_until_end(process: subprocess.Popen[str]) -> dict[int, set[str]]:
    """The addresses of all Internet sockets of a process and its descendants, looked at every second until it ends."""
    seen: dict[int, set[str]] = defaultdict(set)

    def has_ended() -> bool:
        address_of = local_addresses()
        for pid in descendants(process.pid):
            with contextlib.suppress(OSError):  # it has just ended
                files = [os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir()]
                seen[pid] |= {address_of[file] for file in files if file in address_of}
        return process.poll() is not None

    wait_for(has_ended, lambda _: time.sleep(1.0), 2 * TIMEOUT)  # two replays share the machine
    return seen


def local_addresses() -> dict[str, str]:
    """Addresses of all Internet sockets of this machine, in hex as in /proc/net, by their names in /proc/<pid>/fd."""
    rows = [
        line.split()
        for protocol in ("udp", "udp6", "tcp", "tcp6", "raw", "raw6")
        for line in Path("/proc/net", protocol).read_text().splitlines()[1:]
    ]
    return {f"socket:[{row[9]}]": row[1].partition(":")[0] for row in rows}


def descendants(pid: int) -> list[int]:
    """The process and all that come from it."""
    try:
        return [pid, *(one for child in children(pid) for one in descendants(child))]
    except FileNotFoundError:  # it has just ended
        return []


def test_a_replay_measures_planned_pipes_and_repeats_itself(tmp_path: Path) -> None:
    bag = cut(tmp_path / "cut.mcap", BOARD_SEEN)
    one, two = tmp_path / "one", tmp_path / "two"
    with foreign_node(DISTURBED, tmp_path / "found"):
        alone = start_replay(bag, one, "--board", str(BOARD))
        disturbed = start_replay(bag, two, "--board", str(BOARD), domain=DISTURBED)
        sockets = addresses_until_end(disturbed)
        for replay in (alone, disturbed):
            _, errors = replay.communicate(timeout=TIMEOUT)
            assert replay.returncode == 0, errors
    # At least: a worker that was just forked has its parent's sockets until it runs its own program.
    assert len([pid for pid, addresses in sockets.items() if addresses]) >= 1 + len(MODULES)
    assert set().union(*sockets.values()) == {LOOPBACK}
    assert set((tmp_path / "found").read_text().split()) == set()
    for name in ("pipes.json", "cloud.ply", "frames.csv"):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name

    assert sorted(file.name for file in one.iterdir()) == [
        *("cloud.las", "cloud.ply", "colmap", "config.yaml", "frames.csv", "map.npz", "out.mcap", "pipes.json"),
        "progress.csv",
        "run.json",
        "trajectory.tum",
    ]
    with (one / "frames.csv").open() as stream:
        considered = [int(row["stamp"]) for row in csv.DictReader(stream)]
    assert considered == [frame.stamp for frame in Bag.open(bag)]
    assert len(considered) == 16

    result = json.loads((one / "pipes.json").read_text())
    assert faults_of_pipes(result) == []
    assert result.keys() == {"frame_id", "scale", "walls_m2", "pipes", "classes", "runs"}
    assert result["frame_id"] == "map"
    assert result["scale"]["source"] == "board"
    assert 0 < result["scale"]["sigma"] < 0.01
    for pipe in result["pipes"]:
        assert pipe.keys() == {
            *("id", "start", "end", "radius", "radius_sigma", "length"),
            *("class", "class_probability", "class_kmeans", "ambiguous", "visible_arc_deg", "rmse", "points"),
            *("length_sigma", "ends", "hidden_m", "not_seen_m"),
        }
        # Each coordinate and the length are rounded to the micrometre.
        assert pipe["length"] == pytest.approx(np.linalg.norm(np.subtract(pipe["end"], pipe["start"])), abs=3e-6)
    planned = {entry["name"]: entry["outer_radius_mm"] / 1000 for entry in yaml.safe_load(BOQ.read_text())["classes"]}
    assert {entry["class"]: entry["outer_radius"] for entry in result["classes"]} == planned
    classified = [pipe for pipe in result["pipes"] if pipe["class"] is not None]
    assert any(abs(pipe["radius"] - planned[pipe["class"]]) < 0.001 for pipe in classified), result["pipes"]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            ["--board", str(BOARD)],
            f"no board (A) of {BOARD} was seen in 8 frames of 8, and nothing else tells the scale",
        ),
        ([], "nothing tells the scale"),
    ],
    ids=["out of view", "not given"],
)
def test_without_a_board_the_reason_is_reported_and_nothing_written(
    tmp_path: Path, options: list[str], reason: str
) -> None:
    replay = start_replay(cut(tmp_path / "cut.mcap", NO_BOARD_SEEN), tmp_path / "out", *options)
    _, errors = replay.communicate(timeout=TIMEOUT)
    assert replay.returncode == 1
    assert reason in errors
    assert "Traceback" not in errors
    assert [file.name for file in tmp_path.iterdir()] == ["cut.mcap"]


class Robot:
    """Publishes images as a camera does, and notes what the graph says."""

    def __init__(self) -> None:
        self.node = Node("robot")
        self.maps: list[PointCloud2] = []
        self.markers: list[MarkerArray] = []
        self.heard: dict[str, int] = defaultdict(int)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._images = self.node.create_publisher(CompressedImage, "image/compressed", qos.reliable(10))
        self._infos = self.node.create_publisher(CameraInfo, "camera_info", qos.reliable(10))
        self.node.create_subscription(PointCloud2, "map_points", self.maps.append, qos.latched())
        self.node.create_subscription(MarkerArray, "pipe_markers", self.markers.append, qos.latched())
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def wait_for(self, condition: Callable[[], object]) -> None:
        wait_for(condition, self._executor.spin_once)

    def is_connected(self) -> bool:
        count = self.node.count_subscribers
        wanted = {"image/compressed": 1, "camera_info": 1, "map_points": 2, "keyframe_poses": 1, "sfm_status": 1}
        wanted |= {"keyframes/image/compressed": 2, "keyframes/camera_info": 2, "image_overlap": 1}
        return len(self.heard) == len(MODULES) and all(count(topic) >= number for topic, number in wanted.items())

    def walk(self, frames: Iterator[ImageMessage], count: int, condition: Callable[[], object]) -> None:
        """Ten frames a second, then one every five seconds until the condition holds.

        Live images are best effort: the later ones make up for those that a busy machine loses.
        """
        for number, frame in enumerate(frames, start=1):
            due = time.monotonic() + (0.1 if number < count else 5.0)
            info = deserialize_message(frame.camera_info, CameraInfo)
            info.header = messages.header(frame.stamp, frame.frame_id)
            self._infos.publish(info)
            self._images.publish(frame.data)
            while (left := due - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=left)
                if number >= count and condition():
                    return
        self.wait_for(condition)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.heard[status.name.partition(":")[0]] += 1


@pytest.fixture
def robot() -> Iterator[Robot]:
    rclpy.init()
    robot = Robot()
    yield robot
    robot.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def nodes(tmp_path: Path) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    parameters = {
        "frames": {"lockstep": False},
        "sfm": {"board": str(BOARD), "map_interval": 4, **COARSE},
        "detect": {"boq": str(BOQ)},
    }
    started = {}
    for name, module in MODULES.items():
        file = tmp_path / f"{name}.yaml"
        file.write_text(yaml.safe_dump({name: {"ros__parameters": parameters[name]}}))
        command = [sys.executable, "-m", module, "--ros-args", "-r", f"__node:={name}", "--params-file", str(file)]
        started[name] = subprocess.Popen(command)
    yield started
    for process in started.values():
        process.kill()  # the kernel ends its worker with it
        process.wait()


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_running(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_a_live_graph_maps_while_the_robot_walks(robot: Robot, nodes: dict[str, subprocess.Popen[bytes]]) -> None:
    robot.wait_for(robot.is_connected)
    robot.heard.clear()
    started, frames = time.monotonic(), iter(Bag.open(BAG))
    robot.walk(frames, 14, lambda: robot.maps and robot.markers)
    robot.walk(frames, 14, lambda: robot.maps[-1].width > robot.maps[0].width)
    elapsed = time.monotonic() - started
    heard = dict(robot.heard)

    assert robot.maps[-1].width > robot.maps[0].width > 0
    assert all(cloud.header.frame_id == "map" for cloud in robot.maps)
    for array in robot.markers:
        assert array.markers[0].action == Marker.DELETEALL
        for marker in array.markers:
            assert marker.header.frame_id == "map"
            assert marker.lifetime.sec == marker.lifetime.nanosec == 0
    assert any(marker.action == Marker.ADD for array in robot.markers for marker in array.markers)

    # Diagnostics come once a second at work, too: a callback that waited for the computing would silence them for most
    # of the time. They are counted, since when each one arrives is up to the machine.
    assert heard.keys() == nodes.keys()
    for name, count in heard.items():
        assert 0.5 * elapsed < count <= elapsed + 2, name

    workers = {name: children(process.pid) for name, process in nodes.items()}
    assert workers["sfm"]
    assert workers["detect"]
    for process in nodes.values():
        process.send_signal(signal.SIGINT)
    assert {name: process.wait(timeout=TIMEOUT) for name, process in nodes.items()} == dict.fromkeys(nodes, 0)
    robot.wait_for(lambda: not any(is_running(pid) for pids in workers.values() for pid in pids))
