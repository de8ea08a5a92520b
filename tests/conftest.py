# SPDX-License-Identifier: Apache-2.0
"""Keeps every test run to itself: on the loopback interface, at ports that no replay and no other run uses."""

import contextlib
import resource
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from pipeprog_bringup.playback.private_network import private_network

_KEPT = contextlib.ExitStack()

# How long an example takes says how busy the machine is, not whether the code is right.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def pytest_configure(config: pytest.Config) -> None:
    """Before any test module initialises ROS; processes that tests start inherit it."""
    folder = _KEPT.enter_context(tempfile.TemporaryDirectory())
    _KEPT.enter_context(private_network(Path(folder)))
    # The processes of pytest-xdist ignore Ctrl-C, and so would all that tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests neither first nor last: after those of what they run, which compile it, and before short ones.

    Two processes would compile the same code at first, and one would wait for the other's long test in the end.
    """
    tests = Path(__file__).parent

    def rank(item: pytest.Item) -> int:
        place = item.path.relative_to(tests).as_posix()
        if place.startswith(("unit/detect/", "unit/sfm/")):
            return 0
        return 1 if place.startswith(("integration/", "unit/examples/")) else 2

    items.sort(key=rank)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Gives the ports back."""
    _KEPT.close()


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Two gigabytes more than are in use: an allocation of what a header declares fails."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 31), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
