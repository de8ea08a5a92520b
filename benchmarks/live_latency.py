# SPDX-License-Identifier: Apache-2.0
"""How long a robot waits: a recording played live at its own speed, and the same recording replayed.

    .venv/bin/python -m benchmarks.live_latency [RECORDING] [--name NAME]

The nodes run as `ros2 launch` starts them, on a network of their own; the images come at the pace of their stamps, best
effort, as a camera's driver sends them. Nobody calls the services `finish`: the final pipes are the last ones that
come. Writes results/live_latency_NAME.json; to be run on an idle machine, after a run that has compiled all code.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from benchmarks.markdown import measured_rows
from benchmarks.recordings import ROOT, Recording, one_recording
from benchmarks.survey import RESULTS, commit, measure, score_figures
from pipeprog_bringup.playback.node_processes import NODE_MODULES, Graph
from pipeprog_bringup.playback.player import IMAGE_TYPES, calibration
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.recording.bag import Bag, ImageMessage
from pipeprog_msgs import msg
from pipeprog_node import qos

QUIET = 15.0  # s without a map or pipes, after which none is to come: a map is made a second after the last keyframe
PATIENCE = 900.0  # s for what takes a minute on an idle machine
IDLE = {"sfm": "waiting for keyframes", "detect": "waiting for a map"}  # diagnostics of nodes whose code is loaded
TICKS = os.sysconf("SC_CLK_TCK")


class Robot(Node):
    """The camera of a robot and what listens to the pipes; `moments` are times [s] from the first image on."""

    def __init__(self, bag: Bag) -> None:
        super().__init__("robot")
        self._bag = bag
        image_type, image_topic = IMAGE_TYPES[bag.image_type]
        self._images = self.create_publisher(image_type, image_topic, qos.sensor(10))
        self._infos = self.create_publisher(CameraInfo, "camera_info", qos.sensor(10))
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.create_subscription(msg.SfmStatus, "sfm_status", self._on_status, qos.latched())
        self.create_subscription(msg.PipeArray, "pipes", self._on_pipes, qos.latched())
        self._health: dict[str, str] = {}
        self._started = self._heard = 0.0
        self._revisions = {"map": 0, "pipes": 0}
        self.moments: dict[str, float] = {}
        self.cpu: dict[str, dict[str, float]] = {}  # seconds by process at these moments
        self.pipes = self.keyframes = 0
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def walk(self) -> None:
        """Waits until the nodes are ready, sends every image at its time, and waits for the last pipes."""
        self._wait(lambda: self._images.get_subscription_count() and all(map(self._is_idle, IDLE)))
        self._started = time.monotonic()
        self._note("start")
        first = None
        for message in self._bag:
            first = message.stamp if first is None else first
            due = self._started + (message.stamp - first) * 1e-9
            self._wait(lambda: time.monotonic() >= due)  # noqa: B023 - called at once
            self._send(message)
        self._note("last frame")
        self._wait(self._is_over)

    def _send(self, message: ImageMessage) -> None:
        self._infos.publish(calibration(message))
        self._images.publish(message.data)

    def _is_idle(self, name: str) -> bool:
        return self._health.get(name) == IDLE[name]

    def _is_over(self) -> bool:
        quiet = time.monotonic() - self._heard > QUIET
        return quiet and 0 < self._revisions["map"] == self._revisions["pipes"]

    def _wait(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            self._executor.spin_once(timeout_sec=0.01)
            if time.monotonic() > deadline:
                raise RuntimeError(f"waited in vain: {self._health}, {self.moments}")

    def _note(self, moment: str) -> None:
        self.moments[moment] = round(time.monotonic() - self._started, 2)
        self.cpu[moment] = {name: seconds for name, (seconds, _) in processes().items()}

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._health[status.name.partition(":")[0]] = status.message

    def _on_status(self, message: msg.SfmStatus) -> None:
        if message.keyframes_registered > self.keyframes:
            self.keyframes = message.keyframes_registered
            self._heard = time.monotonic()
        if message.metric and "board measured" not in self.moments:
            self._note("board measured")
        if message.map_revision > self._revisions["map"]:
            self._revisions["map"] = message.map_revision
            self._heard = time.monotonic()

    def _on_pipes(self, message: msg.PipeArray) -> None:
        self._revisions["pipes"] = message.map_revision
        self._heard = time.monotonic()
        self.pipes = len(message.pipes)
        if message.pipes and "first pipes" not in self.moments:
            self._note("first pipes")
        self._note("final pipes")


def processes() -> dict[str, tuple[float, int]]:
    """CPU time [s] and largest resident memory [MiB] of the nodes and their workers, by name."""
    found = {}
    for pid in _children(os.getpid()):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            command = Path(f"/proc/{pid}/cmdline").read_text()
            for name in [name for name, module in NODE_MODULES.items() if module in command]:
                found[name] = _cost(pid)
                for worker in _children(pid):
                    if "spawn_main" in Path(f"/proc/{worker}/cmdline").read_text():
                        found[f"{name}, worker"] = _cost(worker)
    return found


def _children(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task").iterdir()
    return [int(child) for thread in threads for child in (thread / "children").read_text().split()]


def _cost(pid: int) -> tuple[float, int]:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    peak = Path(f"/proc/{pid}/status").read_text().partition("VmHWM:")[2].split()[0]
    return (int(fields[11]) + int(fields[12])) / TICKS, int(peak) // 1024  # utime, stime


def live(recording: Recording, folder: Path) -> dict[str, Any]:
    """The moments of a live run, and what each process has cost until then."""
    folder.mkdir(parents=True, exist_ok=True)
    parameters: dict[str, dict[str, Any]] = {
        "frames": {},
        "sfm": {"board": str(recording.beside("board.yaml"))},
        "detect": {"boq": str(recording.beside("boq.yaml"))},
    }
    with private_network(folder), Graph(parameters, folder):
        rclpy.init()
        try:
            robot = Robot(Bag.open(recording.bag))
            robot.walk()
            peaks = {name: peak for name, (_, peak) in processes().items()}
        finally:
            rclpy.try_shutdown()
    moments = robot.moments
    return {
        "moments_s": moments,
        "first pipes after the board is measured [s]": round(moments["first pipes"] - moments["board measured"], 1),
        "final pipes after the last frame [s]": round(moments["final pipes"] - moments["last frame"], 1),
        "keyframes": robot.keyframes,
        "pipes": robot.pipes,
        "cpu_s": {
            "walking": _between(robot.cpu["start"], robot.cpu["last frame"]),
            "after the last frame": _between(robot.cpu["last frame"], robot.cpu["final pipes"]),
        },
        "peak_mib": peaks | {"all": sum(peaks.values())},
    }


def _between(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    return {name: round(seconds - before.get(name, 0.0), 1) for name, seconds in after.items()}


def replayed(recording: Recording, folder: Path) -> dict[str, Any]:
    """Time and score of a replay, beside the length of the recording."""
    figures = measure(recording, (), folder)
    stamps = [message.stamp for message in Bag.open(recording.bag)]
    length = (stamps[-1] - stamps[0]) * 1e-9
    return {
        "recording_s": round(length, 1),
        "replay / recording": round(figures["wall_s"] / length, 2),
        **{key: figures[key] for key in ("wall_s", "cpu_s", "largest_process_mib", "timings_s", "keyframes")},
        "score": score_figures(figures["score"]),
    }


def main() -> None:
    """Measure one recording."""
    recording, name, command = one_recording("live_latency", __doc__)
    folder = ROOT / "out" / "live" / name
    content = {
        "title": f"Live and replay of {name}: latencies, CPU time and memory",
        "command": command,
        "commit": commit(),
        "findings": {"processors": os.cpu_count(), "load before": round(os.getloadavg()[0], 2)},
        "rows": measured_rows({"live": live(recording, folder), "replay": replayed(recording, folder / "replay")}),
    }
    (RESULTS / f"live_latency_{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
