# SPDX-License-Identifier: Apache-2.0
"""The whole graph under attack over real DDS: no node ends, no worker stays away, what is dropped is counted.

A node that ends would do so at the first of these messages; thousands of them and a recording afterwards are
benchmarks/hostile_messages.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy

from benchmarks.hostile_messages import LiveGraph, Peer, attack, set_absurd_parameters

MESSAGES = 40  # on each topic, of eight kinds


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[Peer]:
    graph = LiveGraph(tmp_path)
    rclpy.init()
    peer = Peer(graph)
    try:
        peer.connect()
        yield peer
    finally:
        peer.node.destroy_node()  # its messages are kept, and would reach the graphs of later tests
        rclpy.shutdown()
        graph.stop()


def test_no_message_and_no_parameter_ends_a_node(peer: Peer) -> None:
    told = attack(peer, MESSAGES, seed=3)
    assert peer.graph.ended == []
    assert peer.graph.without_worker == []
    topics = {key.partition(":")[0] for counts in told["dropped"].values() for key in counts}
    assert topics == set(told["sent"])
    # All but ROS's own switch of the clock are read-only.
    assert {name.partition(".")[2] for name in set_absurd_parameters(peer)} <= {"use_sim_time"}
    peer.settle()
    assert peer.graph.ended == []
