# SPDX-License-Identifier: Apache-2.0
"""Notices a session in which nothing moves any more, or a node that has fallen silent."""

from __future__ import annotations

import time

from pipeprog_bringup.playback.node_processes import NodeFailure

SILENCE_SECONDS = 60.0  # without diagnostics, which come once a second: the node hangs
# At most two keyframes, of seconds each, and a few images lie between two answers of the nodes.
STANDSTILL_SECONDS = 300.0


class Watchdog:
    """Remembers when something last moved and when each node was last heard; times of `time.monotonic`."""

    def __init__(self) -> None:
        self._moved = time.monotonic()
        self._heard: dict[str, float] = {}
        self._processes: dict[str, str] = {}
        self._restarted: list[str] = []

    def moved(self) -> None:
        """An image was sent or answered, or a new stage begins."""
        self._moved = time.monotonic()

    def heard(self, name: str, process: str = "") -> None:
        """A node has sent its diagnostics from this process; empty: it does not say from which."""
        self._heard[name] = time.monotonic()
        if process and self._processes.setdefault(name, process) != process:
            self._processes[name] = process
            self._restarted.append(name)

    def knows(self, name: str) -> bool:
        """Whether a node has been heard: only then it is noticed that it is started anew."""
        return name in self._heard

    def restarted(self) -> list[str]:
        """The nodes that have died and were started anew since the last call."""
        names, self._restarted = self._restarted, []
        return names

    def check_movement(self, stage: str, counts: str) -> None:
        """Raises NodeFailure, with `counts` in its text, where nothing has moved for STANDSTILL_SECONDS."""
        if time.monotonic() - self._moved > STANDSTILL_SECONDS:
            raise NodeFailure(f"nothing has moved for {STANDSTILL_SECONDS:.0f} s while {stage}: {counts}")

    def check_nodes(self) -> None:
        """Raises NodeFailure where a node that was heard before is silent for SILENCE_SECONDS."""
        now = time.monotonic()
        for name, heard in self._heard.items():
            if now - heard > SILENCE_SECONDS:
                raise NodeFailure(f"the node {name} has sent no diagnostics for {SILENCE_SECONDS:.0f} s: it hangs")
