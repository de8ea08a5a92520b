# SPDX-License-Identifier: Apache-2.0
"""Why images or odometry do not come: what nobody publishes, what has another name, and what does not fit."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from pipeprog_camera.outside_text import nearest

PATIENCE = 5.0  # s without a decision on an image; the slowest cameras of robots send one a second
_IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
_INFOS = ("sensor_msgs/msg/CameraInfo",)
_ODOMETRY = ("nav_msgs/msg/Odometry",)
_OWN = "keyframes/"  # images that the graph publishes itself


def missing_input(node: Node, cameras: Sequence[str] = ()) -> str:
    """A sentence on the first of the cameras' topics that does not come; empty where all are published.

    `node` has the names that `frames` has; `cameras`: what the topics of a rig begin with, none: one camera.
    """
    for beginning in [f"{camera}/" for camera in cameras] or [""]:
        images = [f"{beginning}{topic}" for topic in ("image/compressed", "image")]
        images += [f"{beginning}compressed"] if beginning else []
        for topics, kinds in ((images, _IMAGES), ([f"{beginning}camera_info"], _INFOS)):
            names = [node.resolve_topic_name(topic) for topic in topics]
            unheard = "frames does not subscribe to it: set its image_transport to any"
            lack = _lack(node, names, kinds, "is the camera's driver running?", unheard)
            if lack:
                return lack
    return ""


def missing_odometry(node: Node) -> str:
    """A sentence on why no odometry comes; empty where it is published and received.

    `node` has the name for it that `sfm` has.
    """
    remedy = "start the robot's driver, or hang up a board and name its file"
    unheard = "sfm does not subscribe to it: remap its topic odometry"
    return _lack(node, [node.resolve_topic_name("odometry")], _ODOMETRY, remedy, unheard)


def _lack(node: Node, topics: Sequence[str], kinds: Sequence[str], remedy: str, unheard: str) -> str:
    """Why nothing comes on any of these topics; empty: something may.

    `remedy`: where nobody publishes a topic of these types; `unheard`: what is said where nobody subscribes.
    """
    published = [topic for topic in topics if node.count_publishers(topic)]
    if not published:
        text = f"nobody publishes {' or '.join(topics)}"
        others = [
            topic
            for topic, types in node.get_topic_names_and_types()
            if set(types) & set(kinds) and node.count_publishers(topic) and _OWN not in topic
        ]
        if not others:
            return f"{text}, nor anything else of {' or '.join(kinds)}: {remedy}"
        return f"{text}; the nearest topic of that kind is {nearest(topics[0], others)}: remap it"
    reasons = [_misfit(node, topic, unheard) for topic in published]
    return reasons[0] if all(reasons) else ""


def _misfit(node: Node, topic: str, unheard: str) -> str:
    """Why a topic that is published is not received; empty: it may be."""
    subscribed = node.get_subscriptions_info_by_topic(topic)
    if not subscribed:
        return f"{topic} is published, and {unheard}"
    for offered in node.get_publishers_info_by_topic(topic):
        for asked in subscribed:
            fits, reason = qos_check_compatible(offered.qos_profile, asked.qos_profile)
            if fits == QoSCompatibility.ERROR:
                return (
                    f"{topic}: {offered.node_name} offers {_told(offered.qos_profile)}, {asked.node_name} asks for "
                    f"{_told(asked.qos_profile)} ({reason.strip()}): set the QoS of one of them"
                )
    return ""


def _told(profile: QoSProfile) -> str:
    return f"{profile.reliability.name} and {profile.durability.name}".lower().replace("_", " ")
