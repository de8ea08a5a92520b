# SPDX-License-Identifier: Apache-2.0
"""What a command says where ROS does not start."""

from __future__ import annotations

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_node.ros_context import ros_context


def test_a_domain_that_is_none_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "abc")
    with pytest.raises(InputError, match=r"ROS_DOMAIN_ID is not an integral number; look at"), ros_context():
        pass
