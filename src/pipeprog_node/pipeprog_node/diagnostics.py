# SPDX-License-Identifier: Apache-2.0
"""The health of a node on /diagnostics, once a second (REP-107)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

PERIOD = 1.0  # [s]
PROCESS = "process"  # key of the number of the node's process: another one has been started anew


class Diagnostics:
    """Publishes what `health` returns: (level, message, values), the level one of DiagnosticStatus.OK, WARN, ERROR."""

    def __init__(self, node: Node, name: str, health: Callable[[], tuple[bytes, str, Mapping[str, Any]]]) -> None:
        self._node, self._health = node, health
        self._name = f"{node.get_fully_qualified_name().lstrip('/')}: {name}"
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: a paused recording stops ROS time, and the diagnostics must go on.
        self._timer = node.create_timer(PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        level, message, values = self._health()
        status = DiagnosticStatus(
            level=level,
            name=self._name,
            message=message,
            hardware_id=self._node.get_namespace(),
            values=[KeyValue(key=key, value=str(value)) for key, value in {**values, PROCESS: os.getpid()}.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
