# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import tempfile
import time
from pathlib import Path

import pytest

from pipeprog_bringup.playback import node_processes
from pipeprog_bringup.playback.node_processes import LOG_ROOM, Graph, NodeFailure, require_ros
from pipeprog_camera.errors import InputError


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
    log = (tmp_path / "frames.log").stat()
    assert log.st_blocks * 512 >= LOG_ROOM > log.st_size, "room for the last words on a disk that is full by then"


def test_a_full_shared_memory_is_told_before_rclpy_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(dir: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(InputError, match="/dev/shm is full"):
        require_ros()


def test_no_shared_memory_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_processes, "SHARED_MEMORY", str(tmp_path / "missing"))
    require_ros()
