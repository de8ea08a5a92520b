# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from pathlib import Path

import pytest

from pipeprog_bringup.playback.node_processes import Graph, NodeFailure


def wait_for_failure(graph: Graph) -> None:
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        graph.check()
        time.sleep(0.02)


def test_a_node_that_stops_by_itself_is_quoted(tmp_path: Path) -> None:
    """A module that does not know ROS arguments stands for a node that refuses its parameters."""
    with Graph({}, tmp_path, {"frames": "json.tool"}) as graph, pytest.raises(NodeFailure) as caught:
        wait_for_failure(graph)
    assert "the node frames (process" in str(caught.value)
    assert "stopped with exit code 2" in str(caught.value)
    assert "json.tool: error: " in str(caught.value)
    assert str(tmp_path / "frames.log") in str(caught.value)
