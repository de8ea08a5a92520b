# SPDX-License-Identifier: Apache-2.0
"""Which nodes of the graph are on a topic, by their names: a count would take a viewer for one of them."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node, NodeNameNonExistentError
from rclpy.topic_endpoint_info import TopicEndpointInfo

FINISH = "pipeprog_msgs/srv/Finish"  # the service by which a stage of the graph is told that nothing more comes


def subscribers(node: Node, topic: str) -> set[str]:
    """Names of the nodes in the namespace of `node` that subscribe to `topic`."""
    return _names(node, node.get_subscriptions_info_by_topic(topic))


def publishers(node: Node, topic: str) -> set[str]:
    """Names of the nodes in the namespace of `node` that publish on `topic`."""
    return _names(node, node.get_publishers_info_by_topic(topic))


def stages_subscribed(node: Node, topic: str) -> set[str]:
    """Names of the graph's nodes that subscribe to `topic`, whatever they were renamed to: all of them offer Finish."""
    found = set()
    for name in subscribers(node, topic):
        try:
            services = node.get_service_names_and_types_by_node(name, node.get_namespace())
        except NodeNameNonExistentError:  # its endpoint was discovered before its name, or it has just ended
            continue
        if any(FINISH in types for _, types in services):
            found.add(name)
    return found


def _names(node: Node, endpoints: Iterable[TopicEndpointInfo]) -> set[str]:
    return {one.node_name for one in endpoints if one.node_namespace == node.get_namespace()}
