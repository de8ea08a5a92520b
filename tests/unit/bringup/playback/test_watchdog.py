# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time

import pytest

from pipeprog_bringup.playback.node_processes import NodeFailure
from pipeprog_bringup.playback.watchdog import SILENCE_SECONDS, STANDSTILL_SECONDS, Watchdog


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


def test_a_node_that_falls_silent_is_named(clock: Clock) -> None:
    watchdog = Watchdog()
    watchdog.check_nodes()
    for name in ("frames", "sfm"):
        watchdog.heard(name)
    clock.now += SILENCE_SECONDS + 1.0
    watchdog.heard("frames")
    with pytest.raises(NodeFailure, match="the node sfm has sent no diagnostics for 60 s"):
        watchdog.check_nodes()


def test_nodes_that_were_started_anew_are_named_once(clock: Clock) -> None:
    watchdog = Watchdog()
    for name in ("frames", "sfm", "frames"):
        watchdog.heard(name, f"process of {name}")
    watchdog.heard("sfm")  # a node that does not say
    assert watchdog.restarted() == []
    watchdog.heard("sfm", "another")
    assert watchdog.restarted() == ["sfm"]
    watchdog.heard("sfm", "another")
    assert watchdog.restarted() == []


def test_a_session_that_stands_still_is_told_with_its_counts(clock: Clock) -> None:
    watchdog = Watchdog()
    clock.now += STANDSTILL_SECONDS - 1.0
    watchdog.check_movement("playing", "")
    watchdog.moved()
    clock.now += STANDSTILL_SECONDS - 1.0
    watchdog.check_movement("playing", "")
    clock.now += 2.0
    with pytest.raises(NodeFailure, match="for 300 s while playing: 3 of 7 images"):
        watchdog.check_movement("playing", "3 of 7 images")
