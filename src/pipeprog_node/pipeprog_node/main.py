# SPDX-License-Identifier: Apache-2.0
"""The main function of every node."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Collection

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import for_terminal
from pipeprog_node.processes.freed_memory import give_back_large_blocks
from pipeprog_node.renewal import MakeNode, RenewableNode

STOP_LATENCY = 0.1  # [s] at most from a signal to the end of a node to which no message comes


def run(node_type: MakeNode, renewed: Collection[str] = ()) -> None:
    """Runs the node until SIGINT or SIGTERM.

    `renewed`: the fields of pipeprog_msgs/Renew that are parameters of the node; with them, it offers `~/renew`.

    The process exits with 0 after SIGINT or SIGTERM, and with 1 and one line on stderr after an InputError.
    """
    give_back_large_blocks()
    # rclpy's own handlers invalidate the context while the executor enters its wait, which then fails or never ends.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # arguments or a parameter file that ROS cannot read
        sys.exit(f"error: {error}")
    node = None
    problem = None
    try:
        executor = SingleThreadedExecutor()
        node = RenewableNode(node_type, executor, renewed)
        while not stop.is_set():
            executor.spin_once(timeout_sec=STOP_LATENCY)
            node.renew_if_asked()
    except InputError as error:
        problem = for_terminal(f"error: {error}")
    finally:
        if node is not None:
            node.destroy()
        rclpy.try_shutdown()
    sys.exit(problem)
