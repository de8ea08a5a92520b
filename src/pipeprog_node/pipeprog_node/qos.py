# SPDX-License-Identifier: Apache-2.0
"""Quality of service of pipeprog's topics, each kind with its reason.

rclpy logs a warning by itself where the publisher and the subscription of a topic do not fit.
"""

from __future__ import annotations

from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

# For topics that come from outside: a robot's driver may want another reliability or depth, set by the parameters
# qos_overrides.<topic>.subscription.<policy>.
OVERRIDABLE = QoSOverridingOptions.with_default_policies()


def sensor(depth: int) -> QoSProfile:
    """Live images: best effort connects to publishers of every kind, and the next image replaces a lost one."""
    return QoSProfile(depth=depth, reliability=QoSReliabilityPolicy.BEST_EFFORT)


def reliable(depth: int) -> QoSProfile:
    """Streams where each message counts: a lost keyframe is a hole in the map."""
    return QoSProfile(depth=depth, reliability=QoSReliabilityPolicy.RELIABLE)


def kept(depth: int) -> QoSProfile:
    """As `reliable`, and a subscriber that comes late still gets the last messages."""
    return QoSProfile(
        depth=depth, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
    )


def latched() -> QoSProfile:
    """States of which only the newest counts, also for those who subscribe later: map, pipes, markers."""
    return kept(1)
