# SPDX-License-Identifier: Apache-2.0
"""The cores of a node and its worker, each in a process of its own: a limit cannot be taken back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BOQ = Path(__file__).parents[4] / "bags" / "demo.boq.yaml"
# Prints how many workers the node has, and the cores of each of their threads and of its own.
PROGRAM = """
import json, multiprocessing, os, sys
import rclpy
from {module} import {node}

rclpy.init(args=sys.argv)
node = {node}()
workers = multiprocessing.active_children()
processes = (os.getpid(), *[worker.pid for worker in workers])
threads = [int(name) for process in processes for name in os.listdir(f"/proc/{{process}}/task")]
print(json.dumps([len(workers), [sorted(os.sched_getaffinity(thread)) for thread in threads]]))
node.destroy_node()
rclpy.shutdown()
"""
ALLOWED = sorted(os.sched_getaffinity(0))


def cores_of(module: str, node: str, *parameters: str) -> tuple[int, list[list[int]], str]:
    """Workers of a node, the cores of each thread of its processes, and what it says on stderr."""
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    program = PROGRAM.format(module=module, node=node)
    done = subprocess.run(
        [sys.executable, "-c", program, "--ros-args", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    workers, cores = json.loads(done.stdout)
    return workers, cores, done.stderr


@pytest.mark.skipif(len(ALLOWED) < 2, reason="one core cannot be limited")
@pytest.mark.parametrize(
    ("module", "node", "workers"),
    [
        ("pipeprog_frames.node", "FramesNode", 0),
        ("pipeprog_sfm.node", "SfmNode", 1),
        ("pipeprog_detect.node", "DetectNode", 1),
    ],
)
def test_a_node_and_its_worker_keep_to_the_cores_that_they_are_given(module: str, node: str, workers: int) -> None:
    files = [f"boq:={BOQ}"] if node == "DetectNode" else []
    found, cores, said = cores_of(module, node, "cores:=1", *files)
    assert found == workers
    assert len(cores) > 1 + workers, "the middleware has threads of its own"
    assert cores == [ALLOWED[:1]] * len(cores)
    assert "cores" not in said


@pytest.mark.parametrize(("given", "warns"), [("cores:=0", False), ("cores:=1024", True)])
def test_more_cores_than_there_are_is_a_warning(given: str, warns: bool) -> None:
    _, cores, said = cores_of("pipeprog_frames.node", "FramesNode", given)
    assert cores == [ALLOWED] * len(cores)
    assert (f"cores = 1024: this process may use {len(ALLOWED)}, and uses them all" in said) == warns
