# SPDX-License-Identifier: Apache-2.0
"""The connections that a session needs before its first image, and which of them are still missing."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node

from pipeprog_node.discovery import publishers, subscribers

LISTENER = ""  # stands for the node that conducts the survey, whatever its name
# Topic -> the nodes that subscribe to it. What is published before a subscriber is found would never reach it.
SUBSCRIBERS = {
    "keyframes/image/compressed": {"sfm", "detect"},
    "keyframes/camera_info": {"sfm", "detect"},
    "image_overlap": {"frames", LISTENER},
    "map_points": {"detect"},
    "keyframe_poses": {"detect"},
    "keyframe_velocities": {"detect"},
    "sfm_status": {"detect", LISTENER},
    "frame_decisions": {LISTENER},
}
PUBLISHERS = {
    "frame_decisions": "frames",
    "image_overlap": "sfm",
    "sfm_status": "sfm",
    "pipes": "detect",
    "pipe_markers": "detect",
}


def missing_connections(node: Node, to_frames: Iterable[str], to_sfm: Iterable[str]) -> list[str]:
    """What the graph still lacks, as seen by `node`; `to_frames` and `to_sfm` are the topics that the session sends."""
    wanted = SUBSCRIBERS | {topic: {"frames"} for topic in to_frames} | {topic: {"sfm"} for topic in to_sfm}
    missing = [
        f"{name} does not subscribe to {topic}"
        for topic, names in wanted.items()
        for name in sorted({name or node.get_name() for name in names} - subscribers(node, topic))
    ]
    missing += [
        f"{name} does not publish {topic}" for topic, name in PUBLISHERS.items() if name not in publishers(node, topic)
    ]
    return missing
