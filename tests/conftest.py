# SPDX-License-Identifier: Apache-2.0
"""Keeps every test run to itself: a ROS domain that no replay and no other run holds, on this machine alone."""

import contextlib
import os
import tempfile
from pathlib import Path

import pytest

from pipeprog_bringup.playback.node_processes import private_domain

_KEPT = contextlib.ExitStack()


def pytest_configure(config: pytest.Config) -> None:
    """Before any test module initialises ROS; processes that tests start inherit it."""
    os.environ.pop("ROS_DOMAIN_ID", None)
    os.environ.pop("ROS_AUTOMATIC_DISCOVERY_RANGE", None)
    logs = _KEPT.enter_context(tempfile.TemporaryDirectory())
    _KEPT.enter_context(private_domain(Path(logs)))


def pytest_unconfigure(config: pytest.Config) -> None:
    """Gives the domain back."""
    _KEPT.close()
