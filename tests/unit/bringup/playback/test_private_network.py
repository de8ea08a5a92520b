# SPDX-License-Identifier: Apache-2.0
"""Ports and settings of the network of one replay; that nothing foreign gets in is tested with the whole graph."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from pipeprog_bringup.playback import private_network as network
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_camera.errors import InputError


def first_port() -> int:
    profile = Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    found = re.search(r"<portBase>(\d+)</portBase>", profile)
    assert found is not None
    return int(found[1])


def test_two_replays_have_ports_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where just these are left: the second replay does not get those that the first has not opened yet."""
    here = 10_000 + os.getpid() % 300 * 2 * network._PORTS  # where no other run of the tests looks
    monkeypatch.setattr(network, "_FIRST_PORTS", [here, here + network._PORTS])
    (tmp_path / "two").mkdir()
    with private_network(tmp_path):
        first = first_port()
        with private_network(tmp_path / "two"):
            assert abs(first_port() - first) >= network._PORTS
            with pytest.raises(InputError, match="do 2 replays run at once"), private_network(tmp_path):
                pass
        assert first_port() == first


def test_no_other_graph_uses_these_ports() -> None:
    """Neither those of any domain (7400 and above) nor what Fast DDS takes beside them, from 400 below the first on."""
    blocks = [range(first, first + network._PORTS) for first in network._FIRST_PORTS]
    beside = {port for first in network._FIRST_PORTS for port in range(first - 400, first - 400 + network._PORTS)}
    assert len({port for block in blocks for port in block}) == sum(map(len, blocks))
    assert all(1024 <= port < 7000 for block in blocks for port in block)
    assert min(beside) >= 1024
    assert not beside & {port for block in blocks for port in block}


def test_settings_of_a_live_graph_do_not_open_a_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live = {
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_STATIC_PEERS": "192.0.2.7",
        "ROS_DISCOVERY_SERVER": "192.0.2.7:11811",
        "ROS_LOCALHOST_ONLY": "1",
        "ROS_SECURITY_ENABLE": "true",
        "FASTRTPS_DEFAULT_PROFILES_FILE": "/robot.xml",
        "FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA",
        "RMW_FASTRTPS_USE_QOS_FROM_XML": "1",
    }
    kept = {"ROS_DOMAIN_ID": "42", "ROS_LOG_DIR": "/logs"}
    for name, value in (live | kept).items():
        monkeypatch.setenv(name, value)
    before = dict(os.environ)
    with private_network(tmp_path):
        assert not any(os.environ.get(name) == value for name, value in live.items())
        assert os.environ["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"
        assert {name: os.environ[name] for name in kept} == kept
    assert dict(os.environ) == before


def test_a_machine_without_loopback_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "LOOPBACK", "192.0.2.77")  # an address that is nobody's (RFC 5737)
    with pytest.raises(InputError, match=r"cannot be used here .*ip link set lo up"), private_network(tmp_path):
        pass
