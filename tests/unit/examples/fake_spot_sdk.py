# SPDX-License-Identifier: Apache-2.0
"""As much of Boston Dynamics' SDK as a remote mission service takes: names and numbers of its contract, no gRPC."""

from __future__ import annotations

import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

TICKED = dict(
    enumerate(("UNKNOWN", "FAILURE", "RUNNING", "SUCCESS", "INVALID_SESSION_ID", "MISSING_LEASES", "MISSING_INPUTS"))
)


@dataclass
class Request:
    """EstablishSession, Tick, Stop or TeardownSession."""

    session_id: str = ""


def _message(*statuses: str) -> type:
    numbers = {f"STATUS_{name}": number for number, name in enumerate(statuses)}
    return type("Response", (), {**numbers, "status": 0, "session_id": "", "error_message": ""})


@contextmanager
def _response_context(response: Any, request: Any) -> Iterator[None]:
    yield


def modules() -> dict[str, types.ModuleType]:
    """The modules that the program imports, by name."""
    names = [
        *("bosdyn", "bosdyn.api", "bosdyn.api.mission", "bosdyn.client", "bosdyn.client.util"),
        *("bosdyn.api.mission.remote_pb2", "bosdyn.api.mission.remote_service_pb2_grpc"),
        *("bosdyn.client.directory_registration", "bosdyn.client.server_util"),
    ]
    found: dict[str, Any] = {name: types.ModuleType(name) for name in names}
    for name in names[1:]:
        parent, _, child = name.rpartition(".")
        setattr(found[parent], child, found[name])
    remote = found["bosdyn.api.mission.remote_pb2"]
    remote.EstablishSessionResponse = _message("UNKNOWN", "OK", "MISSING_LEASES", "MISSING_INPUTS")
    remote.TickResponse = _message(*TICKED.values())
    remote.StopResponse = remote.TeardownSessionResponse = _message("UNKNOWN", "OK", "INVALID_SESSION_ID")
    found["bosdyn.api.mission.remote_service_pb2_grpc"].RemoteMissionServiceServicer = object
    found["bosdyn.client.server_util"].ResponseContext = _response_context
    found["bosdyn.client.server_util"].GrpcServiceRunner = object
    registration = found["bosdyn.client.directory_registration"]
    registration.DirectoryRegistrationClient = registration.DirectoryRegistrationKeepAlive = object
    return found
