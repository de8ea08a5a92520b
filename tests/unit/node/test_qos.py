# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

from pipeprog_node import qos


@pytest.mark.parametrize(
    ("profile", "depth", "reliable", "kept"),
    [
        (qos.sensor(10), 10, False, False),
        (qos.reliable(50), 50, True, False),
        (qos.kept(50), 50, True, True),
        (qos.latched(), 1, True, True),
    ],
    ids=["sensor", "reliable", "kept", "latched"],
)
def test_who_subscribes_late_gets_what_is_kept(profile: QoSProfile, depth: int, reliable: bool, kept: bool) -> None:
    assert profile.depth == depth
    assert (profile.reliability == QoSReliabilityPolicy.RELIABLE) == reliable
    assert (profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL) == kept
