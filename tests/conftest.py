# SPDX-License-Identifier: Apache-2.0
"""Keeps every test run to itself: on the loopback interface, at ports that no replay and no other run uses."""

import contextlib
import tempfile
from pathlib import Path

import pytest

from pipeprog_bringup.playback.private_network import private_network

_KEPT = contextlib.ExitStack()


def pytest_configure(config: pytest.Config) -> None:
    """Before any test module initialises ROS; processes that tests start inherit it."""
    folder = _KEPT.enter_context(tempfile.TemporaryDirectory())
    _KEPT.enter_context(private_network(Path(folder)))


def pytest_unconfigure(config: pytest.Config) -> None:
    """Gives the ports back."""
    _KEPT.close()
