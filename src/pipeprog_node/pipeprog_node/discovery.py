"""Which nodes of the graph are on a topic, by their names: a count would take a viewer for one of them."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo


def subscribers(node: Node, topic: str) -> set[str]:
    """Names of the nodes in the namespace of `node` that subscribe to `topic`."""
    return _names(node, node.get_subscriptions_info_by_topic(topic))


def publishers(node: Node, topic: str) -> set[str]:
    """Names of the nodes in the namespace of `node` that publish on `topic`."""
    return _names(node, node.get_publishers_info_by_topic(topic))


def _names(node: Node, endpoints: Iterable[TopicEndpointInfo]) -> set[str]:
    return {one.node_name for one in endpoints if one.node_namespace == node.get_namespace()}
