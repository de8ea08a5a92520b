# SPDX-License-Identifier: Apache-2.0
"""What the nodes publish during a session: decisions, overlaps, status, diagnostics, and the last messages."""

from __future__ import annotations

import dataclasses
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMsg
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from visualization_msgs.msg import MarkerArray

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.watchdog import Watchdog
from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import PROCESS
from pipeprog_node.keyframe_input import REFINED_CALIBRATION

_OPTIONAL = {
    "refined": (CameraInfo, REFINED_CALIBRATION),
    "velocities": (msg.KeyframeVelocities, "keyframe_velocities"),
}
_RESULTS = {"cloud": (PointCloud2, "map_points"), "poses": (PathMsg, "keyframe_poses")} | {
    "pipes": (msg.PipeArray, "pipes"),
    "markers": (MarkerArray, "pipe_markers"),
}
# Results that carry the stamp of their map.
_OF_ONE_MAP = {"cloud", "poses", "pipes", "velocities"}


@dataclasses.dataclass(frozen=True)
class LastMessages:
    """The last messages of the graph, all of one map.

    `refined` where the survey has refined the calibration, `velocities` with a rolling shutter.
    """

    cloud: PointCloud2
    poses: PathMsg
    pipes: msg.PipeArray
    markers: MarkerArray
    refined: CameraInfo | None = None
    velocities: msg.KeyframeVelocities | None = None


class Listener:
    """Subscribes to what the nodes answer, writes it to `log` and tells `watchdog` that something moves.

    `status` is the SfM's last, `answered` the number of keyframes that it has worked off.
    """

    def __init__(self, node: Node, log: FrameLog, watchdog: Watchdog) -> None:
        self._node, self._log, self._watchdog = node, log, watchdog
        self._results: dict[str, Any] = {}
        self.status = msg.SfmStatus()
        self.answered = 0
        node.create_subscription(msg.FrameDecision, "frame_decisions", self._on_decision, qos.reliable(1000))
        node.create_subscription(msg.ImageOverlapArray, "image_overlap", self._on_overlap, qos.kept(1000))
        node.create_subscription(msg.SfmStatus, "sfm_status", self._on_status, qos.latched())
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def receive(self, *names: str) -> None:
        """Subscribe to results that are complete (cloud, poses, pipes, markers): just the last message comes."""
        for name in names:
            kind, topic = (_RESULTS | _OPTIONAL)[name]

            def keep(message: Any, name: str = name) -> None:
                self._results[name] = message

            self._node.create_subscription(kind, topic, keep, qos.latched())

    def results(self) -> LastMessages:
        """The results that were received; `missing_results` must be empty."""
        return LastMessages(**{name: self._results[name] for name in self._expected})

    def missing_results(self, revision: int) -> str:
        """What lacks until all results are there and of the map `revision`; empty when nothing does."""
        absent = [topic for name, topic in self._expected.items() if name not in self._results]
        if absent:
            return f"these results have not come: {', '.join(absent)}"
        stamps = {messages.stamp_ns(self._results[name].header.stamp) for name in _OF_ONE_MAP & self._expected.keys()}
        newest = min(self.status.map_revision, self._results["pipes"].map_revision) >= revision
        if newest and len(stamps) == 1:
            return ""
        return "cloud, poses and pipes are not of one map; does another graph run in this ROS domain?"

    @property
    def _expected(self) -> dict[str, str]:
        """The topics of the results that belong to the last map, by name."""
        is_sent = {"refined": self.status.camera_refined, "velocities": self.status.readout > 0.0}
        return {name: topic for name, (_, topic) in (_RESULTS | _OPTIONAL).items() if is_sent.get(name, True)}

    def _on_decision(self, message: msg.FrameDecision) -> None:
        self._watchdog.moved()
        self._log.decide(
            FrameRow(
                messages.stamp_ns(message.header.stamp),
                message.chosen,
                message.reason,
                overlap_predicted=message.overlap,
                parallax=message.parallax,
                sharpness=message.sharpness,
            )
        )

    def _on_overlap(self, message: msg.ImageOverlapArray) -> None:
        self._watchdog.moved()
        self.answered = message.keyframes_considered
        for image in message.images:
            stamp = messages.stamp_ns(image.stamp)
            self._log.overlap(stamp, image.overlap, image.cell_overlap, image.tie_points, image.registered)

    def _on_status(self, message: msg.SfmStatus) -> None:
        self.status = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            process = next((value.value for value in status.values if value.key == PROCESS), "")
            self._watchdog.heard(status.name.partition(":")[0], process)
