# SPDX-License-Identifier: Apache-2.0
"""Fuzzed messages on every subscription of a live graph, then a good recording: does all go on, are the pipes the same?

    .venv/bin/python -m benchmarks.hostile_messages [--count 10000] [--seed 1]

Real nodes over real DDS on the loopback interface. The same recording goes through a graph that was not attacked.
Writes results/hostile_messages.json.

To be fair, the attack's good messages are older than the recording: another survey, not lies about this one. The
recording is played as slowly as the reconstruction takes its keyframes, since live nodes drop what they cannot follow.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Bool

from benchmarks.recordings import DEMO, ROOT
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.playback.node_processes import NODE_MODULES
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.recording.bag import Bag
from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos
from tests.fuzz.fuzzed_messages import fuzzed_stream, good_messages

PATIENCE = 300.0  # s for what takes seconds on an idle machine
ACKNOWLEDGED = 5.0  # s that an acknowledgement may take; the middleware gives up some damaged bytes without one
BETWEEN_WAITS = 20  # messages on each topic between two waits for the nodes to have worked them off
PAUSE = 0.02  # s after a message on each topic: a node takes some milliseconds for its own
PAUSED = "survey/paused"  # a topic on which no message is invalid: it is switched on and off
IN_FLIGHT = 10  # frames of the recording that are sent and not decided on
FROM_OUTSIDE = ("camera_info", "image/compressed", "image", "odometry", "imu", "/tf", "/tf_static")
WITH_WORKERS = ("sfm", "detect")
# Two live runs of one recording differ: the selector hears of overlaps at other moments and chooses other keyframes.
RADIUS_TOLERANCE = 0.001  # m
LENGTH_TOLERANCE = 0.03  # m
ABSURD = (
    ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float("nan")),
    ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=-(2**63)),
    ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="\x1b[31m" * 1000),
    ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"\xff"] * 1000),
    ParameterValue(type=ParameterType.PARAMETER_NOT_SET),
)


class LiveGraph:
    """The three nodes as processes of their own, with their output in files."""

    def __init__(self, folder: Path) -> None:
        reliable = {f"qos_overrides.{_full(topic)}.subscription.reliability": "reliable" for topic in FROM_OUTSIDE}
        parameters: dict[str, dict[str, Any]] = {
            "frames": reliable | {"lockstep": False},
            "sfm": reliable | {"board": str(DEMO.beside("board.yaml"))},
            "detect": {"boq": str(DEMO.beside("boq.yaml"))},
        }
        self.processes = {name: self._start(folder, name, parameters[name]) for name in NODE_MODULES}
        self.workers: dict[str, set[int]] = {name: set() for name in WITH_WORKERS}  # all that were ever seen

    @staticmethod
    def _start(folder: Path, name: str, parameters: dict[str, Any]) -> subprocess.Popen[bytes]:
        file = folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump({name: {"ros__parameters": parameters}}))
        command = [sys.executable, "-m", NODE_MODULES[name], "--ros-args", "-r", f"__node:={name}"]
        with (folder / f"{name}.log").open("wb") as log:
            return subprocess.Popen([*command, "--params-file", str(file)], stdout=log, stderr=log)

    @property
    def ended(self) -> list[str]:
        """Nodes that are no more."""
        return [name for name, process in self.processes.items() if process.poll() is not None]

    @property
    def without_worker(self) -> list[str]:
        """Nodes whose child process is missing now."""
        missing = []
        for name in WITH_WORKERS:
            workers = _workers(self.processes[name].pid)
            self.workers[name] |= workers
            missing += [] if workers else [name]
        return missing

    @property
    def worst_bytes(self) -> int:
        """Largest memory that a node or a worker has had."""
        pids = [process.pid for process in self.processes.values()]
        return max(_peak(pid) for pid in (*pids, *(worker for pid in pids for worker in _workers(pid))))

    def stop(self) -> None:
        """Ends all; the kernel ends a worker with its node."""
        for process in self.processes.values():
            process.kill()
            process.wait()


class Peer:
    """A participant of the graph: publishes on every topic, hears diagnostics, answers and pipes, calls services."""

    def __init__(self, graph: LiveGraph) -> None:
        self.graph = graph
        self.node = Node("peer")
        self.values: dict[str, dict[str, str]] = {}  # of the diagnostics, by node
        self.decided: set[int] = set()
        self.keyframes: set[int] = set()
        self.answered: set[int] = set()
        self.pipes: dict[int, list[msg.Pipe]] = {}  # by revision of the map
        self.unacknowledged: Counter[str] = Counter()  # waits for a topic's acknowledgements that were given up
        self.worst_seconds = 0.0  # from a message to the answer of the slowest node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        # A publisher that keeps fits every subscription, those of latched topics, too.
        self._publishers = {
            topic: self.node.create_publisher(type(message), topic, qos.kept(10))
            for topic, message in good_messages(0).items()
        } | {PAUSED: self.node.create_publisher(Bool, PAUSED, qos.kept(10))}
        subscribe = self.node.create_subscription
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        subscribe(msg.FrameDecision, "frame_decisions", self._on_decision, qos.reliable(1000))
        subscribe(CameraInfo, "keyframes/camera_info", self._on_keyframe, qos.reliable(50))
        subscribe(msg.ImageOverlapArray, "image_overlap", self._on_answer, qos.kept(50))
        subscribe(msg.PipeArray, "pipes", self._on_pipes, qos.latched())
        self._probes = {name: self.node.create_client(GetParameters, f"{name}/get_parameters") for name in NODE_MODULES}

    def connect(self) -> None:
        """Waits until every node hears, and until nothing is subscribed to that is not attacked."""
        self.wait_for(lambda: all(one.get_subscription_count() for one in self._publishers.values()))
        self.wait_for(lambda: self.values.keys() == NODE_MODULES.keys())
        known = {self.node.resolve_topic_name(topic) for topic in self._publishers}
        for name in NODE_MODULES:
            for topic, _ in self.node.get_subscriber_names_and_types_by_node(name, "/"):
                assert topic in known, f"{name} subscribes to {topic}, which is not attacked"
        self.wait_for(lambda: not self.graph.without_worker)

    def publish(self, topic: str, content: Any) -> None:
        """Publishes a message, or its CDR bytes."""
        self._publishers[topic].publish(content)

    def settle(self) -> None:
        """Returns when every node has taken what was published."""
        started = time.perf_counter()
        for topic, publisher in self._publishers.items():
            if not publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED)):
                self.unacknowledged[topic] += 1
        # An executor works off its subscriptions before its services.
        answers = [probe.call_async(GetParameters.Request(names=["use_sim_time"])) for probe in self._probes.values()]
        self.wait_for(lambda: all(answer.done() for answer in answers))
        self.worst_seconds = max(self.worst_seconds, time.perf_counter() - started)

    def call(self, service_type: Any, name: str, request: Any) -> Any:
        """The answer of a service."""
        client = self.node.create_client(service_type, name)
        self.wait_for(client.service_is_ready)
        answer = client.call_async(request)
        self.wait_for(answer.done)
        self.node.destroy_client(client)
        return answer.result()

    def wait_for(self, condition: Callable[[], object]) -> None:
        """Spins; RuntimeError where a node has ended or the condition does not come."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if self.graph.ended:
                raise RuntimeError(f"ended: {', '.join(self.graph.ended)}")
            if time.monotonic() > deadline:
                raise RuntimeError("waited in vain")
            self._executor.spin_once(timeout_sec=0.1)

    def pause(self) -> None:
        """Hears what comes for `PAUSE`."""
        until = time.monotonic() + PAUSE
        while (left := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def spin(self, seconds: float) -> None:
        """Hears what comes for a time [s]."""
        until = time.monotonic() + seconds
        self.wait_for(lambda: time.monotonic() > until)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.partition(":")[0]
            self.values[name] = {pair.key: pair.value for pair in status.values}

    def _on_decision(self, message: msg.FrameDecision) -> None:
        self.decided.add(messages.stamp_ns(message.header.stamp))

    def _on_keyframe(self, message: CameraInfo) -> None:
        self.keyframes.add(messages.stamp_ns(message.header.stamp))

    def _on_answer(self, message: msg.ImageOverlapArray) -> None:
        self.answered.add(messages.stamp_ns(message.header.stamp))

    def _on_pipes(self, message: msg.PipeArray) -> None:
        self.pipes[message.map_revision] = list(message.pipes)


def attack(peer: Peer, count: int, seed: int) -> dict[str, Any]:
    """Sends `count` messages on each topic; what was sent and, of that, dropped by the nodes."""
    streams = {topic: fuzzed_stream(topic, seed, samples) for topic, samples in _recorded().items()}
    kinds: Counter[str] = Counter()
    for number in range(count):
        for topic, stream in streams.items():
            fuzzed = next(stream)
            kinds[fuzzed.kind] += 1
            peer.publish(topic, fuzzed.content)
        peer.publish(PAUSED, Bool(data=number % 2 == 0))
        peer.pause()
        if number % BETWEEN_WAITS == BETWEEN_WAITS - 1:
            peer.settle()
        if number % 100 == 99:
            print(f"{number + 1} of {count} on each of {len(streams)} topics", flush=True)
            _ = peer.graph.without_worker  # notes the workers that are there
    peer.publish(PAUSED, Bool())
    peer.spin(2.0)  # two diagnostics
    peer.wait_for(lambda: not peer.graph.without_worker)
    return {
        "sent": dict.fromkeys(streams, count),
        "sent of each kind": dict(sorted(kinds.items())),
        "waits for acknowledgements given up": dict(peer.unacknowledged),
        "dropped": {node: _dropped(values) for node, values in peer.values.items()},
    }


def _dropped(values: dict[str, str]) -> dict[str, int]:
    """Of a node's diagnostics the messages that were dropped, by "topic: kind"."""
    prefix = "dropped on "
    return {key.removeprefix(prefix): int(value) for key, value in values.items() if key.startswith(prefix)}


def set_absurd_parameters(peer: Peer) -> list[str]:
    """Sets every parameter of every node to values of other types and ranges; those that were taken."""
    taken = []
    for node in NODE_MODULES:
        for name in peer.call(ListParameters, f"{node}/list_parameters", ListParameters.Request()).result.names:
            request = SetParameters.Request(parameters=[Parameter(name=name, value=value) for value in ABSURD])
            results = peer.call(SetParameters, f"{node}/set_parameters", request).results
            taken += [f"{node}.{name}"] if any(result.successful for result in results) else []
    return taken


def absurd_finish(peer: Peer) -> dict[str, str]:
    """The nodes' answers to a request that expects more inputs than can come."""
    request = srv.Finish.Request(expected_inputs=2**32 - 1)
    clients = {name: peer.node.create_client(srv.Finish, f"{name}/finish") for name in NODE_MODULES}
    peer.wait_for(lambda: all(client.service_is_ready() for client in clients.values()))
    answers = {name: client.call_async(request) for name, client in clients.items()}
    peer.wait_for(lambda: all(answer.done() for answer in answers.values()))
    return {name: answer.result().message for name, answer in answers.items()}


def survey(peer: Peer) -> list[msg.Pipe]:
    """Plays the recording and finishes the survey; its pipes."""
    peer.wait_for(lambda: peer.values["sfm"]["waiting"] == "0")
    peer.spin(2.0)  # two diagnostics
    # An image of the attack may wait there for a calibration of its size.
    received = int(peer.values["frames"]["frames considered"]) + int(peer.values["frames"]["queued"])
    frames = list(Bag.open(DEMO.bag))
    stamps = {frame.stamp for frame in frames}
    for number, frame in enumerate(frames, start=1):
        info = deserialize_message(frame.camera_info, CameraInfo)
        info.header = messages.header(frame.stamp, frame.frame_id)
        peer.publish("camera_info", info)
        peer.publish("image/compressed", frame.data)
        peer.wait_for(lambda: number - len(stamps & peer.decided) < IN_FLIGHT)  # noqa: B023 - called at once
        peer.wait_for(lambda: peer.keyframes & stamps <= peer.answered)
    _finish(peer, "frames", received + len(frames))
    peer.wait_for(lambda: peer.keyframes & stamps <= peer.answered)
    revision = _finish(peer, "sfm", 0)
    _finish(peer, "detect", revision)
    peer.wait_for(lambda: revision in peer.pipes)
    return peer.pipes[revision]


def _finish(peer: Peer, node: str, expected: int) -> int:
    answer = peer.call(srv.Finish, f"{node}/finish", srv.Finish.Request(expected_inputs=expected))
    if not answer.success:
        raise RuntimeError(f"{node}: {answer.message}")
    return int(answer.outputs)


def _recorded() -> dict[str, list[Any]]:
    """For each topic the recording's own messages, at the time of the attack."""
    samples: dict[str, list[Any]] = {topic: [] for topic in good_messages(0)}
    for number, frame in zip(range(8), Bag.open(DEMO.bag), strict=False):
        header = good_messages(4 + number)["image/compressed"].header
        image, info = (
            deserialize_message(frame.data, CompressedImage),
            deserialize_message(frame.camera_info, CameraInfo),
        )
        image.header = info.header = header
        for prefix in ("", "keyframes/"):
            samples[f"{prefix}image/compressed"].append(image)
            samples[f"{prefix}camera_info"].append(info)
    return samples


def differences(pipes: list[msg.Pipe], others: list[msg.Pipe]) -> list[str]:
    """What differs between the pipes of two surveys beyond the tolerances, in words."""
    found = []
    ours, theirs = (sorted((pipe.class_name, _length(pipe), pipe.radius) for pipe in some) for some in (pipes, others))
    if [name for name, *_ in ours] != [name for name, *_ in theirs]:
        return [f"classes {[name for name, *_ in ours]} and {[name for name, *_ in theirs]}"]
    for (name, length, radius), (_, other_length, other_radius) in zip(ours, theirs, strict=True):
        if abs(length - other_length) > LENGTH_TOLERANCE:
            found.append(f"{name}: length {length:.3f} m and {other_length:.3f} m")
        if abs(radius - other_radius) > RADIUS_TOLERANCE:
            found.append(f"{name}: radius {1e3 * radius:.2f} mm and {1e3 * other_radius:.2f} mm")
    return found


@contextlib.contextmanager
def live(folder: Path) -> Iterator[Peer]:
    """A graph and a peer that is connected to it."""
    folder.mkdir(parents=True, exist_ok=True)
    with private_network(folder):
        graph = LiveGraph(folder)
        rclpy.init()
        try:
            peer = Peer(graph)
            peer.connect()
            yield peer
        finally:
            rclpy.try_shutdown()
            graph.stop()


def main() -> None:
    """Attack one graph, leave another alone, and compare what they make of the recording."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hostile_messages", description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="messages on each topic")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    out = ROOT / "out" / "hostile"
    with live(out / "attacked") as peer:
        told = attack(peer, arguments.count, arguments.seed)
        told["parameters that took an absurd value"] = set_absurd_parameters(peer)
        told["answers to an absurd Finish"] = absurd_finish(peer)
        missing, worst_bytes = peer.graph.without_worker, peer.graph.worst_bytes
        restarted = {name: len(seen) - 1 for name, seen in peer.graph.workers.items()}
        worst_seconds, attacked, ended = peer.worst_seconds, survey(peer), peer.graph.ended
    # In a process of its own: the middleware reads where its network is once a process.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        alone = pool.apply(survey_alone, (out / "alone",))
    found = differences(attacked, alone)
    failures = [{"name": name, "reason": "the node ended"} for name in ended]
    failures += [{"name": name, "reason": "its worker is missing"} for name in missing]
    failures += [{"name": "pipes", "reason": one} for one in found]
    content = {
        "what": "fuzzed messages on every subscription of a live graph over DDS, then the recording of the demo",
        "command": f"python -m benchmarks.hostile_messages --count {arguments.count} --seed {arguments.seed}",
        "commit": commit(),
        "tried": sum(told["sent"].values()),
        "failed": len(failures),
        "failures": failures,
        "limits": {"seconds": PATIENCE},
        "worst_seconds": round(worst_seconds, 2),
        "worst_bytes": worst_bytes,
        "workers started again": restarted,
        "pipes": [_row(one, other) for one, other in zip(_ordered(attacked), _ordered(alone), strict=False)],
        **told,
    }
    (RESULTS / "hostile_messages.json").write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))


def survey_alone(folder: Path) -> list[msg.Pipe]:
    """The pipes of a graph that nobody attacks."""
    with live(folder) as peer:
        return survey(peer)


def _ordered(pipes: list[msg.Pipe]) -> list[msg.Pipe]:
    return sorted(pipes, key=lambda pipe: (pipe.class_name, _length(pipe)))


def _row(attacked: msg.Pipe, alone: msg.Pipe) -> dict[str, Any]:
    return {
        "class": alone.class_name,
        "length, attacked [m]": round(_length(attacked), 4),
        "length, alone [m]": round(_length(alone), 4),
        "radius, attacked [mm]": round(1e3 * attacked.radius, 3),
        "radius, alone [mm]": round(1e3 * alone.radius, 3),
    }


def _length(pipe: msg.Pipe) -> float:
    start, end = pipe.start, pipe.end
    return float(((end.x - start.x) ** 2 + (end.y - start.y) ** 2 + (end.z - start.z) ** 2) ** 0.5)


def _full(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


def _workers(pid: int) -> set[int]:
    """Child processes that work: the other one keeps the books of multiprocessing."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    found = set()
    with contextlib.suppress(OSError):  # it has ended meanwhile
        for child in children.read_text().split():
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.add(int(child))
    return found


def _peak(pid: int) -> int:
    """Largest resident memory [bytes] of a process."""
    with contextlib.suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024
    return 0


if __name__ == "__main__":
    main()
