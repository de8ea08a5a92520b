# SPDX-License-Identifier: Apache-2.0
"""rclpy in the process of a command."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import rclpy
from rclpy.signals import SignalHandlerOptions

from pipeprog_camera.errors import InputError


@contextlib.contextmanager
def ros_context() -> Iterator[None]:
    """rclpy for this process; Ctrl-C stays Python's KeyboardInterrupt. Raises InputError where ROS does not start."""
    try:
        rclpy.init(args=["--ros-args", "--log-level", "error"], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        reason = str(error).partition(", at /")[0]  # without the line of ROS's source
        raise InputError(f"ROS 2 does not start: {reason}; look at the environment variables ROS_*") from None
    try:
        yield
    finally:
        rclpy.try_shutdown()
