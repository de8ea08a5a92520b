"""The main function of every node."""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from pipeprog_camera.errors import InputError


def run(node_type: Callable[[], Node]) -> None:
    """Runs the node until it is told to stop.

    The process exits with 0 after SIGINT or SIGTERM, and with 1 and one line on stderr after an InputError.
    """
    try:
        rclpy.init()
    except RuntimeError as error:  # arguments or a parameter file that ROS cannot read
        sys.exit(f"error: {error}")
    node = None
    problem = None
    try:
        node = node_type()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except InputError as error:
        problem = f"error: {error}"
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(problem)
