# SPDX-License-Identifier: Apache-2.0
"""A graph with the node `survey` under a supervisor that starts anew what dies, and a robot that films the demo."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_srvs.srv import Trigger

from benchmarks.recordings import ROOT
from pipeprog_bringup.recording.bag import Bag, ImageMessage
from pipeprog_bringup.simulated_patrol import MODULES
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import FrameDecision, ImageOverlapArray
from pipeprog_node import messages, qos

BOQ, BOARD, DEMO = (ROOT / "bags" / f"demo.{end}" for end in ("boq.yaml", "board.yaml", "mcap"))
COARSE = {"stereo.width": 640, "fusion.voxel": 0.006}  # what is measured is the graph, not its accuracy
RESPAWN_DELAY = 2.0  # s, as the launch file has it
PERIOD = 0.1  # s between two images
DEFERRED = 1.0  # s for the decision on an image: the selector takes 10 ms
ATTEMPTS = 20  # to send a goal: a node that is started anew is active a moment later
ANSWER = 5.0  # s for the answer to a goal: none comes from a node that is not there
SILENT = 10.0  # s without feedback, of which two a second come
PATIENCE = 600.0  # s for what takes a minute on an idle machine


class LiveGraph:
    """Context in which the four nodes run, each a process that is started again after its death."""

    def __init__(self, folder: Path, settings: dict[str, Any], intermediate: bool = True, timed: bool = False) -> None:
        """`folder` takes parameter files, logs and, under `surveys`, the results; `settings`: of sfm.

        Without `intermediate` there is the last map alone, as in a replay. `timed`: for `longest_turns`.
        """
        self._folder, self._timed = folder, timed
        self._parameters: dict[str, dict[str, Any]] = {
            "frames": {"idle": True},
            "sfm": {"map_interval": 4, "intermediate": intermediate, **settings},
            "detect": {"boq": str(BOQ), "intermediate": intermediate},
            "survey": {"boq": str(BOQ), "board": str(BOARD), "results": str(folder / "surveys")},
        }
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._dead_since: dict[str, float] = {}
        self.starts: Counter[str] = Counter()  # of each process

    def __enter__(self) -> LiveGraph:
        for name in MODULES:
            self._start(name)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()

    def supervise(self) -> None:
        """Starts what has been dead for RESPAWN_DELAY; to be called often."""
        now = time.monotonic()
        for name, process in self._processes.items():
            if process.poll() is not None and now - self._dead_since.setdefault(name, now) > RESPAWN_DELAY:
                del self._dead_since[name]
                self._start(name)

    def kill(self, name: str, worker: bool = False) -> bool:
        """Kills a node's process, or the child in which it computes; whether there was one."""
        number = self._processes[name].pid
        found = _workers(number) if worker else [number] * (self._processes[name].poll() is None)
        for each in found:
            os.kill(each, signal.SIGKILL)
        return bool(found)

    def memory(self, workers: bool = False) -> dict[str, float]:
        """MB that each node's process holds for itself: its unique set, that of its `workers` if asked for."""
        return {
            name: sum(_unique_mb(each) for each in (process.pid, *(_workers(process.pid) if workers else ())))
            for name, process in self._processes.items()
        }

    def longest_turns(self) -> dict[str, float]:
        """Of each node the longest turn of its executor so far, s: a wait of 0.1 s at the most, and a callback."""
        return {name: float(self._turn_of(name).read_text()) for name in MODULES}

    def _turn_of(self, name: str) -> Path:
        return self._folder / f"{name}.turn"

    def _start(self, name: str) -> None:
        self.starts[name] += 1
        file = self._folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump({name: {"ros__parameters": self._parameters[name]}}))
        timed = ["benchmarks.timed_node", str(self._turn_of(name))] if self._timed else []
        command = [sys.executable, "-m", *timed, MODULES[name], "--ros-args", "-r", f"__node:={name}"]
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                [*command, "--params-file", str(file)], stdout=log, stderr=subprocess.STDOUT
            )


def _workers(number: int) -> list[int]:
    """Children of a process that compute: those of multiprocessing, less the one that tracks its resources."""
    children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
    return [int(each) for each in children if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]


def _unique_mb(number: int) -> float:
    text = Path(f"/proc/{number}/smaps_rollup").read_text()
    rows = [line.split() for line in text.splitlines()[1:]]
    return sum(int(row[1]) for row in rows if row[0].startswith("Private_")) / 1024.0


class Robot:
    """A robot whose camera never rests, and the client of its surveys; `patience` [s] is what it waits at the most."""

    patience = PATIENCE

    def __init__(self, graph: LiveGraph, frames: Sequence[ImageMessage], patient: bool = False) -> None:
        """`frames`: what it passes on its walk; it goes on once an image of a place was decided on.

        patient: it sends each image once, under its own stamp, and goes on once the SfM has answered to all keyframes.
        """
        self._graph, self._frames, self._patient = graph, frames, patient
        self._chosen = self._answered = 0  # keyframes
        self._is_over, self._shown_at, self._feedback_at = False, 0.0, 0.0
        self.feedback: list[Survey.Feedback] = []
        self._handle: ClientGoalHandle | None = None
        self._node = Node("robot")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._images = self._node.create_publisher(CompressedImage, "image/compressed", qos.reliable(10))
        self._infos = self._node.create_publisher(CameraInfo, "camera_info", qos.reliable(10))
        self._stamps = itertools.count(1_700_000_000_000_000_000, 200_000_000)
        self._place = 0
        self._shown = self._decided = 0  # stamps of the first image of that place, and of the last decision
        self._node.create_subscription(FrameDecision, "frame_decisions", self._on_decision, qos.reliable(1000))
        self._node.create_subscription(ImageOverlapArray, "image_overlap", self._on_answer, qos.kept(50))
        self._node.create_timer(PERIOD, self._film)
        self._client = ActionClient(self._node, Survey, "survey")
        self._state = self._node.create_client(ChangeState, "survey/change_state")
        self._end = self._node.create_client(Trigger, "survey/end")

    @property
    def is_at_the_end(self) -> bool:
        """Whether the walk is over."""
        return self._place == len(self._frames) - 1 and self._has_passed

    def activate(self) -> None:
        """Configures and activates the node survey."""
        for step in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert self._called(self._state, ChangeState.Request(transition=Transition(id=step))).success

    def survey(self, name: str, each: Callable[[], None] = lambda: None) -> Any:
        """Walks once, and returns the answer of the action; `each` is called again and again meanwhile.

        A request for the result is lost while the node that was started anew has not found this one yet, and is
        sent again where nothing is heard.
        """
        self.feedback.clear()
        self._place, self._shown, self._decided = -1, 0, 0
        self._chosen = self._answered = 0
        self._is_over = False
        over, ended, lives = self._asked_for(name), False, self._graph.starts["survey"]
        while True:
            asked = time.monotonic()
            self.wait_for(
                lambda over=over, ended=ended, lives=lives, asked=asked: (  # type: ignore[misc]
                    over.done()
                    or self._graph.starts["survey"] > lives
                    or (not ended and self._is_filming() and self.is_at_the_end)
                    or self._is_silent(asked)
                ),
                each,
            )
            is_known = not over.done() or over.result().status != GoalStatus.STATUS_UNKNOWN
            if self._graph.starts["survey"] > lives or not is_known:
                # It may have died before it noted that filming has ended.
                over, ended, lives = self._asked_for(name), False, self._graph.starts["survey"]
            elif over.done():
                return over.result()
            elif self._is_silent(asked) and self._handle is not None:
                over = self._handle.get_result_async()
            else:
                ended = self._has_ended()

    def cancel(self) -> None:
        """Cancels the survey that runs; its answer tells what became of that."""
        if self._handle is not None:
            self._handle.cancel_goal_async()

    def _is_silent(self, since: float) -> bool:
        """Whether nothing has been heard of the survey for some time, nor since a moment."""
        return time.monotonic() > max(since, self._feedback_at) + SILENT

    def _on_feedback(self, heard: Any) -> None:
        self._feedback_at = time.monotonic()
        self.feedback.append(heard.feedback)

    def _has_ended(self) -> bool:
        """Whether the node has ended filming; a node that dies meanwhile gives no answer."""
        answer = self._end.call_async(Trigger.Request())
        waited = time.monotonic() + ANSWER
        self.wait_for(lambda: answer.done() or time.monotonic() > waited)
        return bool(answer.done() and answer.result().success)

    def _asked_for(self, name: str) -> Any:
        """The future of a goal's answer, sent until it is accepted."""
        for _ in range(ATTEMPTS):
            self.wait_for(self._client.server_is_ready)
            sent = self._client.send_goal_async(Survey.Goal(survey_id=name), self._on_feedback)
            waited = time.monotonic() + ANSWER
            self.wait_for(lambda sent=sent, waited=waited: sent.done() or time.monotonic() > waited)  # type: ignore[misc]
            if sent.done() and sent.result().accepted:
                self._handle = sent.result()
                return self._handle.get_result_async()
        raise RuntimeError(f"the goal {name} was refused {ATTEMPTS} times")

    def wait_for(self, condition: Callable[[], object], each: Callable[[], None] = lambda: None) -> None:
        """Lets time pass until a condition holds; raises TimeoutError when patience is over."""
        deadline = time.monotonic() + self.patience
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {self.patience:.0f} s in vain")
            self._executor.spin_once(timeout_sec=PERIOD)
            self._graph.supervise()
            each()

    def _is_filming(self) -> bool:
        return bool(self.feedback) and self.feedback[-1].state == Survey.Feedback.FILMING

    def _called(self, client: Any, request: Any) -> Any:
        self.wait_for(client.service_is_ready)
        answer = client.call_async(request)
        self.wait_for(answer.done)
        return answer.result()

    def _film(self) -> None:
        if not self._is_filming() or self._is_over:
            return
        stamp, is_new = next(self._stamps), self._has_passed
        if is_new:
            self._place = min(self._place + 1, len(self._frames) - 1)
            self._shown = self._frames[self._place].stamp if self._patient else stamp
            self._shown_at = time.monotonic()
        if self._patient and not is_new:
            return
        self._is_over = self._patient and self._place == len(self._frames) - 1
        frame = self._frames[self._place]
        info = deserialize_message(frame.camera_info, CameraInfo)
        image = deserialize_message(frame.data, CompressedImage)
        info.header = image.header = messages.header(self._shown if self._patient else stamp, frame.frame_id)
        self._infos.publish(info)
        self._images.publish(image)

    @property
    def _has_passed(self) -> bool:
        """Whether the place that it shows is done with."""
        is_decided = self._decided >= self._shown
        if not self._patient:
            return is_decided
        # The selector may put a decision off until further images have come.
        waited = time.monotonic() - self._shown_at > DEFERRED
        return self._answered >= self._chosen and (is_decided or waited)

    def _on_decision(self, message: FrameDecision) -> None:
        self._decided = max(self._decided, messages.stamp_ns(message.header.stamp))
        self._chosen += message.chosen

    def _on_answer(self, message: ImageOverlapArray) -> None:
        self._answered = message.keyframes_considered


def demo_frames() -> list[ImageMessage]:
    """The demo from the first frame that shows the whole board on."""
    return list(Bag.open(DEMO))[3:]
