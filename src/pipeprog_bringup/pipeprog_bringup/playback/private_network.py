# SPDX-License-Identifier: Apache-2.0
"""The network of one replay: sockets on the loopback interface alone, at ports that no other ROS graph uses.

Participants of DDS find each other by announcing themselves at port numbers that follow from the domain (RTPS 2.2,
9.6.1.1). With other numbers a replay and a foreign graph never hear of each other, whatever their domains are.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import socket
from collections.abc import Iterator
from pathlib import Path

from pipeprog_camera.errors import InputError

LOOPBACK = "127.0.0.1"
_PARTICIPANTS = 16  # processes that can find each other: three nodes, the command, and what a test adds
_PORTS = 2 * _PARTICIPANTS  # one for discovery and one for data each
# First ports. A domain's are from 7400 on, and Linux gives those from 32768 on to other programs. Fast DDS takes one
# more port of each process from 400 below the first on (so those of other graphs are 7000 to 7399): blocks of 400 with
# as many between them keep these apart from the ports of other replays.
_FIRST_PORTS = [block + offset for block in range(2000, 6800, 800) for offset in range(0, 400 - _PORTS, _PORTS)]
# Bytes of a socket buffer, as far as the kernel allows (net.core.rmem_max): the usual 208 KiB hold three packets, and
# a busy reader loses most of a cloud of 60 MB, which are sent again; with 4 MiB it loses few.
_BUFFER = 4 << 20
# What is set for live graphs: it would add peers, transports, a discovery server, or keys that the nodes lack.
_LIVE_SETTINGS = re.compile(
    r"(FASTDDS|FASTRTPS|RMW)_|ROS_(DISCOVERY_SERVER|LOCALHOST_ONLY|SECURITY_|STATIC_PEERS|SUPER_CLIENT)"
)
# No multicast: a unicast address without one takes its place, port 0 stands for those of all participants. Shared
# memory is left out: its files outlive a killed process, and containers have 64 MiB of it.
_PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>loopback</transport_id>
      <type>UDPv4</type>
      <sendBufferSize>{buffer}</sendBufferSize>
      <receiveBufferSize>{buffer}</receiveBufferSize>
      <interfaceWhiteList><address>{loopback}</address></interfaceWhiteList>
      <maxInitialPeersRange>{participants}</maxInitialPeersRange>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="replay" is_default_profile="true">
    <rtps>
      <port>
        <portBase>{first_port}</portBase>
        <domainIDGain>0</domainIDGain>
        <participantIDGain>2</participantIDGain>
        <offsetd0>0</offsetd0>
        <offsetd1>0</offsetd1>
        <offsetd2>1</offsetd2>
        <offsetd3>1</offsetd3>
      </port>
      <builtin>
        <metatrafficUnicastLocatorList><locator/></metatrafficUnicastLocatorList>
        <initialPeersList><locator><udpv4><address>{loopback}</address></udpv4></locator></initialPeersList>
      </builtin>
      <userTransports><transport_id>loopback</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""


@contextlib.contextmanager
def private_network(folder: Path) -> Iterator[None]:
    """Set ROS, for this process and its children, to a network of our own; `folder` takes its profile and ROS's logs.

    Raises InputError where there is no loopback interface or no free ports.
    """
    _require_loopback()
    first_port, lock = _free_ports()
    profile = folder / "network.xml"
    profile.write_text(
        _PROFILE.format(loopback=LOOPBACK, buffer=_BUFFER, participants=_PARTICIPANTS, first_port=first_port)
    )
    chosen = {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",  # what the profile is for; the default of ROS 2 Jazzy
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile),
        "SKIP_DEFAULT_XML_FILE": "1",  # no other profile from the working directory
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",  # LOCALHOST would add transports on every interface
        "ROS_LOG_DIR": os.environ.get("ROS_LOG_DIR") or str(folder),
    }
    before = dict(os.environ)
    for name in filter(_LIVE_SETTINGS.match, before):
        del os.environ[name]
    os.environ.update(chosen)
    try:
        yield
    finally:
        for name in chosen:
            del os.environ[name]
        os.environ.update({name: value for name, value in before.items() if name not in os.environ})
        lock.close()


def _require_loopback() -> None:
    """Raises InputError where nothing can be sent over the loopback interface."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((LOOPBACK, 0))  # fails without the address
            probe.connect(probe.getsockname())  # fails while the interface is down
    except OSError as error:
        raise InputError(
            f"the nodes of a replay talk over {LOOPBACK}, which cannot be used here ({error.strerror}): bring up the "
            f"loopback interface, as root with `ip link set lo up`, and `ip address add {LOOPBACK}/8 dev lo` where it "
            "lacks the address"
        ) from None


def _free_ports() -> tuple[int, socket.socket]:
    """First of a range of ports that no other replay on this machine holds; with the lock that holds it."""
    for first in random.SystemRandom().sample(_FIRST_PORTS, len(_FIRST_PORTS)):
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # An abstract name: gone with the process, however that ends.
            lock.bind(f"\0pipeprog-ros-ports-{first}")
            for port in range(first, first + _PORTS):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                    probe.bind((LOOPBACK, port))
        except OSError:
            lock.close()
            continue
        return first, lock
    raise InputError(
        f"the nodes of a replay need {_PORTS} free UDP ports in a row between {_FIRST_PORTS[0]} and "
        f"{_FIRST_PORTS[-1] + _PORTS}, and there are none: do {len(_FIRST_PORTS)} replays run at once?"
    )
