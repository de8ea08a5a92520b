# SPDX-License-Identifier: Apache-2.0
"""A live survey of half an hour: memory, answers, and what became of each image.

    .venv/bin/python -m benchmarks.long_survey [--minutes 30]

A robot walks along the demo and back, again and again, at its own pace, with ten images of 720p a second (each frame of
the demo twice). Once a minute are read: the memory that each node and its worker hold for themselves, how many
keyframes the map has, and how long the longest turn of each node's executor was, a wait of 0.1 s at the most and a
callback. Ten times a second each node is asked for a parameter, and for the description of it: the longest time between
two of its answers is what another node notices. (It holds more than callbacks: packets that a cloud of 30 MB pushes out
of a socket come again, those of questions, too.) Each image that was sent must have a decision. Writes
results/long_survey.json.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.client import Client
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage

from benchmarks.live_graph import PATIENCE, LiveGraph, Robot, demo_frames
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.simulated_patrol import MODULES
from pipeprog_msgs.msg import FrameDecision, SfmStatus
from pipeprog_node import messages, qos

IMAGES_PER_FRAME = 2  # the demo has 5 frames a second
WARM = 5  # minutes after which memory is to be flat
ASKED = 0.1  # s between two questions to a node
QUESTIONS = {"get_parameters": GetParameters, "describe_parameters": DescribeParameters}


class Walker(Robot):
    """A robot that walks along the demo and back, whatever becomes of its images, for some minutes."""

    def __init__(self, graph: LiveGraph, minutes: int) -> None:
        self._minutes, self._began = minutes, 0.0
        self.patience = 60.0 * minutes + PATIENCE
        self.sent = 0
        self.decided: dict[int, str] = {}  # reason of the last decision by stamp of the image
        self.slowest = dict.fromkeys(MODULES, 0.0)  # s between two answers
        self.rows: list[dict[str, Any]] = []
        self._registered = 0
        frames = demo_frames()
        super().__init__(graph, frames)
        self._node.create_subscription(SfmStatus, "sfm_status", self._on_status, qos.latched())
        there = [
            (deserialize_message(frame.camera_info, CameraInfo), deserialize_message(frame.data, CompressedImage))
            for frame in frames
        ]
        self._path = [each for each in (*there, *there[-2:0:-1]) for _ in range(IMAGES_PER_FRAME)]
        self._frame_id = frames[0].frame_id
        self._clients = {
            name: [self._node.create_client(kind, f"{name}/{service}") for service, kind in QUESTIONS.items()]
            for name in MODULES
        }
        self._asked: dict[str, float] = {}  # when a node was asked last
        self._heard: dict[str, float] = {}  # when it answered last

    @property
    def is_at_the_end(self) -> bool:
        """Whether the time is over."""
        return bool(self._began) and time.monotonic() - self._began > 60.0 * self._minutes

    def look(self) -> None:
        """Asks the nodes, and reads their memory once a minute."""
        for name, clients in self._clients.items():
            self._ask(name, clients)
        minute = len(self.rows) + 1
        if self._began and time.monotonic() - self._began > 60.0 * minute and minute <= self._minutes:
            memory = self._graph.memory(workers=True)
            self.rows.append(
                {
                    "minute": minute,
                    "images": self.sent,
                    "keyframes chosen": self._chosen,
                    "keyframes in the map": self._registered,
                    **{f"{name} [MB]": round(value) for name, value in memory.items()},
                    "all [MB]": round(sum(memory.values())),
                    **self.times(),
                }
            )
            print(json.dumps(self.rows[-1]), flush=True)

    def times(self) -> dict[str, float]:
        """Of each node so far the longest turn, and the longest time without an answer, s."""
        kinds = {"turn": self._graph.longest_turns(), "without an answer": self.slowest}
        return {
            f"longest {kind} of {name} [s]": round(value, 2)
            for kind, values in kinds.items()
            for name, value in values.items()
        }

    def _ask(self, name: str, clients: Sequence[Client]) -> None:
        now = time.monotonic()
        is_due = self._began and now - self._asked.get(name, 0.0) > ASKED
        if is_due and all(client.service_is_ready() for client in clients):
            self._asked[name] = now
            for client in clients:
                asked = client.call_async(client.srv_type.Request(names=["use_sim_time"]))
                asked.add_done_callback(lambda _: self._heard.update({name: time.monotonic()}))
        if name in self._heard:
            self.slowest[name] = max(self.slowest[name], now - self._heard[name])

    def _film(self) -> None:
        if not self._is_filming() or self.is_at_the_end:
            return
        self._began = self._began or time.monotonic()
        info, image = self._path[self.sent % len(self._path)]
        info.header = image.header = messages.header(time.time_ns(), self._frame_id)
        self._infos.publish(info)
        self._images.publish(image)
        self.sent += 1

    def _on_status(self, message: SfmStatus) -> None:
        self._registered = message.keyframes_registered

    def _on_decision(self, message: FrameDecision) -> None:
        super()._on_decision(message)
        self.decided[messages.stamp_ns(message.header.stamp)] = message.reason


def growth(rows: list[dict[str, Any]]) -> float:
    """Percent a minute by which memory grows once the graph is warm."""
    warm = [(row["minute"], row["all [MB]"]) for row in rows if row["minute"] > WARM]
    if len(warm) < 2:
        return float("nan")
    minute, memory = np.array(warm, float).T
    return float(100.0 * np.polyfit(minute, memory, 1)[0] / memory.mean())


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.long_survey", description=__doc__)
    parser.add_argument("--minutes", type=int, default=30)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, private_network(Path(scratch)):
        rclpy.init()
        with LiveGraph(Path(scratch), {}, timed=True) as graph:
            robot = Walker(graph, options.minutes)
            robot.activate()
            answer = robot.survey("long", robot.look)
            times = robot.times()
    decisions = Counter(reason.split(":")[0].rstrip(" 0123456789.<>") for reason in robot.decided.values())
    result = {
        "title": "A live survey of half an hour",
        "command": f"python -m benchmarks.long_survey --minutes {options.minutes}",
        "commit": commit(),
        "findings": {
            "images sent": robot.sent,
            "images with a decision": len(robot.decided),
            "decisions": dict(decisions.most_common(8)),
            "pipes": [pipe.class_name for pipe in answer.result.pipes.pipes],
            "error code": int(answer.result.error_code),
            f"growth of memory from minute {WARM} on, a minute [%]": round(growth(robot.rows), 2),
            **times,
        },
        "rows": robot.rows,
    }
    (RESULTS / "long_survey.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
