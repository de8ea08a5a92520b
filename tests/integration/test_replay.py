# SPDX-License-Identifier: Apache-2.0
"""The command's side of a replay: real processes over real DDS, with nodes that only count."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from geometry_msgs.msg import TransformStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results.scored_files import read_result
from pipeprog_camera.camera import Camera

ROOT = Path(__file__).parents[2]
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
PLAYING = 110.0  # s that 23 frames, 0.1 s apart, last at a rate of 0.02
START = 1_700_000_000_000_000_000
BOQ = "classes: [{name: DN65, outer_radius_mm: 36.5, planned_length_m: 3.0}]\n"
RUNNER = """
import sys
from pathlib import Path
from pipeprog_bringup import cli, replay
from pipeprog_bringup.playback.node_processes import NODE_MODULES
fakes = dict.fromkeys(NODE_MODULES, "tests.integration.fake_node")
run = replay.replay
replay.replay = lambda request, report, tell: run(request, report, tell, fakes)
sys.argv[0] = "pipeprog"
cli.main()
"""


def jpeg(number: int) -> bytes:
    pixels = np.random.default_rng(number).integers(0, 255, (48, 64), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def write_bag(path: Path, frames: int = 23, damaged: int | None = None, motion: int = 0, odometries: int = 1) -> Path:
    with path.open("wb") as stream, BagWriter(stream) as writer:
        for number in range(motion):
            stamp = START + number * 10_000_000
            for topic in ("/odom", "/visual_odom")[:odometries]:
                writer.write(topic, cdr.ODOMETRY, serialize_message(Odometry()), stamp)
            writer.write("/imu", cdr.IMU, serialize_message(Imu())[: 40 if number == 7 else None], stamp)
        if motion:
            transforms = TFMessage(transforms=[TransformStamped(), TransformStamped()])
            writer.write("/tf_static", cdr.TF, serialize_message(transforms), START)
        for number in range(frames):
            stamp = START + number * 100_000_000
            image = cdr.write_compressed_image(stamp, "camera", "jpeg", jpeg(number))
            if number == damaged:
                image = image[:60]
            writer.write("/camera/camera_info", cdr.CAMERA_INFO, cdr.write_camera_info(stamp, "camera", CAMERA), stamp)
            writer.write("/camera/image/compressed", cdr.COMPRESSED_IMAGE, image, stamp)
    return path


# No board, since a recording of noise would be refused for showing none.
BOARD = "marks: [{circle_radius_mm: 50, distance_mm: 2134.0, sigma_mm: 1}]\n"


def start(folder: Path, *options: str, fault: str = "", **recording: int) -> subprocess.Popen[str]:
    bag = write_bag(folder / "bag.mcap", **recording)
    (folder / "boq.yaml").write_text(BOQ)
    (folder / "board.yaml").write_text(BOARD)
    files = ["--boq", str(folder / "boq.yaml"), "--board", str(folder / "board.yaml")]
    arguments = ["replay", str(bag), *files, "--out", str(folder / "out"), *options]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    told = {"FAKE": fault, "FAKE_FOLDER": str(folder)}
    environment = {**os.environ, **told, "PYTHONPATH": path, "TMPDIR": str(folder)}
    return subprocess.Popen(
        [sys.executable, "-c", RUNNER, *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def nodes_of(parent: int) -> dict[str, int]:
    """Process numbers of the nodes that a replay has started."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    nodes = {}
    for child in children:
        command = Path(f"/proc/{child}/cmdline").read_text()
        if "__node:=" in command:
            nodes[command.split("__node:=")[1].split("\0")[0]] = int(child)
    return nodes


def wait_for(condition, seconds: float = 20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def is_running(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_every_frame_is_considered_and_the_results_are_written(tmp_path: Path) -> None:
    process = start(tmp_path, "--set", "sfm.mapper.max_features=1234", damaged=4)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    out = tmp_path / "out"
    names = sorted(file.name for file in out.iterdir())
    assert names == [
        *("cloud.las", "cloud.ply", "config.yaml", "frames.csv", "out.mcap", "pipes.json", "progress.csv", "run.json"),
        "trajectory.tum",
    ]
    with (out / "frames.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["stamp"]) for row in rows] == [START + number * 100_000_000 for number in range(23)]
    assert rows[4]["reason"] == "damaged message"
    assert [row["overlap_n"] for row in rows if row["chosen"] == "1"] == ["0.7500"] * 5
    facts = json.loads((out / "run.json").read_text())
    assert facts["frames_considered"] == facts["frames_in_bag"] == 23
    assert "max_features: 1234" in (out / "config.yaml").read_text()
    assert read_result(out / "pipes.json").pipes[0].class_name == "DN65"
    assert "DN65" in output
    assert str(out / "pipes.json") in output.replace("\n", "")
    with (out / "out.mcap").open("rb") as recorded:
        reader = make_reader(recorded, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
        topics = [message.channel.topic for message in decoded]
        (record,) = reader.iter_metadata()
    latched = {m.channel.topic for m in decoded if "durability: 1" in m.channel.metadata["offered_qos_profiles"]}
    assert latched == {"/map_points", "/pipes", "/pipe_markers", "/keyframe_poses", "/sfm_status"}
    images = {
        m.message.log_time: m.decoded_message for m in decoded if m.channel.topic == "/keyframes/image/compressed"
    }
    moved = {m.message.log_time: m.decoded_message.transforms for m in decoded if m.channel.topic == "/tf"}
    outlined = {m.message.log_time for m in decoded if m.channel.topic == "/keyframes/outlines"}
    assert outlined == moved.keys() == images.keys(), "each keyframe has its place and its outlines"
    for stamp, (transform,) in moved.items():
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", images[stamp].header.frame_id)
        assert str(transform.header.stamp) == str(images[stamp].header.stamp), "decoded as two classes of one name"
    assert record.metadata == {"site": "boq", "survey": "out", "bag": "bag.mcap", "pipeprog": "0.1.0"}
    assert topics.count("/keyframes/image/compressed") == topics.count("/keyframes/camera_info") == 5
    assert {"/map_points", "/pipes", "/pipe_markers", "/keyframe_poses", "/sfm_status"} < set(topics)


def test_what_a_robot_publishes_of_its_motion_reaches_the_sfm(tmp_path: Path) -> None:
    """The replay ends well only when the SfM has heard every message."""
    process = start(tmp_path, motion=150)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "several topics" not in errors
    motion = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["replay"]["motion_topics"]
    assert motion == {"/odom": "odometry", "/imu": "imu", "/tf_static": "/tf_static"}


def test_motion_that_is_not_used_is_told(tmp_path: Path) -> None:
    process = start(tmp_path, motion=3, odometries=2)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "several topics of nav_msgs/msg/Odometry, and none is used" in errors
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert len(run["notes"]) == 1
    assert run["losses"] == []


@pytest.mark.parametrize("node", ["frames", "sfm", "detect"])
def test_a_killed_node_is_named_and_leaves_no_orphans(tmp_path: Path, node: str) -> None:
    process = start(tmp_path, "--rate", "0.02", fault=f"child of {node}")
    wait_for(lambda: (tmp_path / "playing").exists() and (tmp_path / "pids").exists())
    nodes = nodes_of(process.pid)
    os.kill(nodes[node], signal.SIGKILL)
    _, errors = process.communicate(timeout=PLAYING / 2)
    assert process.returncode == 1
    assert f"the node {node} " in errors
    assert "SIGKILL" in errors
    assert "Traceback" not in errors
    assert not (tmp_path / "out").exists()
    child = int((tmp_path / "pids").read_text().split()[1])
    assert not any(is_running(pid) for pid in (*nodes.values(), child))


def test_a_node_that_dies_at_the_end_is_named_too(tmp_path: Path) -> None:
    process = start(tmp_path, fault="sfm dies at the end")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "the node sfm " in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_all_and_writes_nothing(tmp_path: Path, number: signal.Signals, code: int) -> None:
    process = start(tmp_path, "--rate", "0.02")
    wait_for((tmp_path / "playing").exists)
    nodes = nodes_of(process.pid)
    process.send_signal(number)
    _, errors = process.communicate(timeout=PLAYING / 2)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert ("Interrupted: nothing was written." in errors) == (number == signal.SIGINT)
    assert not (tmp_path / "out").exists()
    assert not any(is_running(pid) for pid in nodes.values())


def test_the_nodes_end_with_a_command_that_is_killed(tmp_path: Path) -> None:
    process = start(tmp_path, "--rate", "0.02")
    nodes = wait_for(lambda: len(nodes_of(process.pid)) == 3 and nodes_of(process.pid))
    process.kill()
    process.communicate()
    wait_for(lambda: not any(is_running(pid) for pid in nodes.values()))


def test_without_a_scale_the_reason_is_reported_and_nothing_written(tmp_path: Path) -> None:
    process = start(tmp_path, fault="no scale")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "no board was seen" in errors
    assert not (tmp_path / "out").exists()
