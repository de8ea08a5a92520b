# SPDX-License-Identifier: Apache-2.0
"""One session: a recording passes once through the running nodes, every frame in, the last messages out."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from pipeprog_bringup.playback.connections import missing_connections
from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.interruption import repeated_signals
from pipeprog_bringup.playback.listener import LastMessages, Listener
from pipeprog_bringup.playback.node_processes import Graph, NodeFailure
from pipeprog_bringup.playback.player import Player
from pipeprog_bringup.playback.watchdog import Watchdog
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.errors import InputError
from pipeprog_msgs import msg, srv

START_SECONDS = 90.0  # until all nodes have found each other: imports of a cold disk included
DELIVERY_SECONDS = 60.0  # for what a node has published already
MIN_KEYFRAMES = 3  # two give a first model, and the third is the first that checks it
_SPIN_SECONDS = 0.1  # between two looks at the nodes' processes
_MOVING = ("choosing keyframes", "working off the last keyframes")  # stages in which decisions and feedback arrive


@dataclasses.dataclass(frozen=True)
class State:
    """Where a replay stands, for the progress display."""

    stage: str
    frames: int
    considered: int
    keyframes: int
    registered: int


class Session:
    """Plays `bag` at `rate` times real time or, with None, as fast as the nodes take it.

    `log` and `timings` [s of each stage] say afterwards what became of the frames.
    """

    def __init__(self, bag: Bag, rate: float | None, report: Callable[[State], None]) -> None:
        self._bag, self._rate, self._report = bag, rate, report
        self.log = FrameLog()
        self.timings: dict[str, float] = {}
        self._stage = ""

    def run(self, graph: Graph) -> tuple[LastMessages, msg.SfmStatus]:
        """Play every frame, let each node finish, and collect the last messages.

        Raises InputError where the recording gives no map, NodeFailure where a node ends, hangs or fails.
        """
        self._graph = graph
        self._node = Node("replay")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        try:
            with repeated_signals() as self._repeat_signals:
                self._connect()
                return self._pass_through()
        finally:
            self._executor.shutdown()
            self._node.destroy_node()

    def _connect(self) -> None:
        """Create the publishers, subscriptions and clients, and wait until the nodes have found them."""
        self._watchdog = Watchdog()
        self._player = Player(self._node, self._bag, self.log)
        self._listener = Listener(self._node, self.log, self._watchdog)
        self._services = {
            name: self._node.create_client(srv.Finish, f"{name}/finish") for name in ("frames", "sfm", "detect")
        }
        with self._timed("start", "starting the nodes"):
            self._wait_until_empty(self._missing_connections, START_SECONDS)

    def _pass_through(self) -> tuple[LastMessages, msg.SfmStatus]:
        with self._timed("play", _MOVING[0]):
            played = self._player.play(self._rate, self._spin, self._pause)
        with self._timed("frames", _MOVING[1]):
            keyframes = self._finish("frames", played)
            self._wait_until_empty(lambda: self._missing_decisions(played), DELIVERY_SECONDS)
        with self._timed("sfm", "reconstructing"):
            self._wait_until_empty(self._missing_motion, DELIVERY_SECONDS)
            revision = self._finish("sfm", keyframes)
        if not revision:
            raise InputError(self._listener.status.message or "nothing was reconstructed: no map came from sfm")
        self._listener.receive("cloud", "poses", "refined", "velocities")
        with self._timed("detect", "detecting pipes"):
            self._finish("detect", revision)
        self._listener.receive("pipes", "markers")
        with self._timed("collect", "collecting the results"):
            self._wait_until_empty(lambda: self._listener.missing_results(revision), DELIVERY_SECONDS)
        return self._listener.results(), self._listener.status

    def _missing_connections(self) -> str:
        missing = missing_connections(self._node, self._player.image_topics, self._player.motion_topics)
        missing += [
            f"{name} offers no service finish" for name, one in self._services.items() if not one.service_is_ready()
        ]
        return f"the nodes have not found each other: {', '.join(missing)}" if missing else ""

    def _missing_decisions(self, played: int) -> str:
        return f"frames decided on {self.log.considered} of {played} images" if self.log.in_flight else ""

    def _missing_motion(self) -> str:
        sent, considered = self._player.motion_sent, self._listener.status.motion_considered
        return f"sfm has worked off {considered} of {sent} messages of motion" if considered < sent else ""

    def _finish(self, name: str, expected: int) -> int:
        """Let a node finish after `expected` inputs; returns the number of outputs it has published."""
        future = self._services[name].call_async(srv.Finish.Request(expected_inputs=expected))
        while not future.done():
            self._spin()
        response = future.result()
        if not response.success:
            # Below MIN_KEYFRAMES it is the frames left out that explain the failure.
            reasons = self.log.common_reasons() if self.log.chosen < MIN_KEYFRAMES else ""
            message = response.message or f"{name} found nothing to work on"
            raise InputError(f"{message} ({reasons})" if reasons else message)
        return response.outputs

    def _spin(self, seconds: float = _SPIN_SECONDS) -> None:
        """Handle what has arrived, show where the session stands, and make sure that every node works."""
        # One callback is handled. With another timeout than in the call before, rclpy looks at the first subscription
        # again, so calls of two timeouts in turn would never come to the others.
        self._executor.spin_once(timeout_sec=min(max(seconds, 0.0), _SPIN_SECONDS))
        self._repeat_signals()
        self._graph.check()
        log, listener = self.log, self._listener
        if self._stage in _MOVING:
            self._watchdog.check_movement(
                self._stage,
                f"frames has decided on {log.considered} images, "
                f"sfm has worked off {listener.answered} of {log.chosen} keyframes",
            )
        self._watchdog.check_nodes()
        registered = listener.status.keyframes_registered
        self._report(State(self._stage, self._bag.image_count, log.considered, log.chosen, registered))

    def _pause(self, due: float) -> None:
        """Spin until `due`, a time of time.monotonic; a pause of our own is no standstill."""
        while (left := due - time.monotonic()) > 0:
            self._spin(left)
            self._watchdog.moved()

    def _wait_until_empty(self, missing: Callable[[], str], seconds: float) -> None:
        """Spin until `missing` returns nothing; raises NodeFailure with what it says after `seconds`."""
        deadline = time.monotonic() + seconds
        while lacking := missing():
            if time.monotonic() > deadline:
                raise NodeFailure(f"waited {seconds:.0f} s: {lacking}")
            self._spin()

    @contextlib.contextmanager
    def _timed(self, name: str, stage: str) -> Iterator[None]:
        self._stage = stage
        self._watchdog.moved()
        started = time.monotonic()
        yield
        self.timings[name] = round(time.monotonic() - started, 3)
