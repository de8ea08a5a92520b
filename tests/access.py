# SPDX-License-Identifier: Apache-2.0
"""What the nodes of a running graph use, and what an access policy of SROS2 allows them."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from xml.etree import ElementTree

import rclpy
from rclpy.context import Context
from rclpy.node import Node

Access = tuple[str, str, str, str]  # enclave, full name of the node, rule, full name of the topic or service
_ACTION = {
    "publish": ("feedback", "status"),
    "reply": ("cancel_goal", "get_result", "send_goal"),
}


def allowed(policy: str) -> set[Access]:
    """What the text of a policy allows; names are completed as SROS2 does."""
    found = set()
    for enclave in ElementTree.fromstring(policy).iter("enclave"):
        for profile in enclave.iter("profile"):
            space = profile.attrib["ns"].rstrip("/")
            node = f"{space}/{profile.attrib['node']}"
            for group in profile:
                ((rule, qualifier),) = group.attrib.items()
                assert qualifier == "ALLOW"
                for item in group:
                    name = _full(item.text or "", space, node)
                    found |= {(enclave.attrib["path"], node, *each) for each in _expanded(rule, name)}
    return found


def used(observer: Node, enclaves: Collection[str]) -> set[Access]:
    """What the nodes in these enclaves publish, subscribe to, offer and call, as far as `observer` has found it."""
    rules = {
        "publish": observer.get_publisher_names_and_types_by_node,
        "subscribe": observer.get_subscriber_names_and_types_by_node,
        "reply": observer.get_service_names_and_types_by_node,
        "request": observer.get_client_names_and_types_by_node,
    }
    return {
        (enclave, f"{space.rstrip('/')}/{name}", rule, used_name)
        for name, space, enclave in observer.get_node_names_and_namespaces_with_enclaves()
        if enclave in enclaves
        for rule, names_of in rules.items()
        for used_name, _ in names_of(name, space)
    }


@contextlib.contextmanager
def observer() -> Iterator[Node]:
    """A node that joins the graph now.

    Of a process that it has not heard for 20 s, the lease of Fast DDS, a node finds the topics again, but never again
    which of its nodes uses them.
    """
    context = Context()
    rclpy.init(context=context)
    node = Node("observer", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def _full(name: str, space: str, node: str) -> str:
    if name.startswith("~"):
        return node + name[1:]
    return name if name.startswith("/") else f"{space}/{name}"


def _expanded(rule: str, name: str) -> list[tuple[str, str]]:
    """A rule for an action as rules for its topics and services."""
    if rule != "execute":
        return [(rule, name)]
    return [(part, f"{name}/_action/{end}") for part, ends in _ACTION.items() for end in ends]
