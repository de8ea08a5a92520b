# SPDX-License-Identifier: Apache-2.0
"""What a worker is given, and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pipeprog_bringup.fleet.recordings import Recording

_LOG_ROOM = 1 << 14  # characters of a log that are kept: a traceback of each node


class SurveyFailure(Exception):
    """A survey that ended otherwise than by its input, with its log: once more may help."""

    def __init__(self, reason: str, log: str = "") -> None:
        super().__init__(reason, log)
        self.reason, self.log = reason, log[-_LOG_ROOM:]


class Unwanted(Exception):
    """Nobody waits for the survey any more."""


class Refused(Exception):
    """The input cannot be surveyed, for the reason that the log ends with: a second try gives the same."""

    def __init__(self, reason: str, log: str = "") -> None:
        super().__init__(reason, log)
        self.reason, self.log = reason, log[-_LOG_ROOM:]


@dataclass(frozen=True)
class Task:
    """A recording, the contents of its bill and boards (empty: none), where the results go, what it may take.

    `boq_kind` is the ending of the bill's name, by which its reader knows it; `memory` is the peak as foreseen [MB].
    """

    recording: Recording
    boq_kind: str
    boq: bytes
    board: bytes
    out: str
    version: str
    cores: int
    memory: int

    @property
    def name(self) -> str:
        """Name of the recording and of its results."""
        return self.recording.name


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: `done`, `kept` (nothing has changed), `refused` (bad input) or `failed`."""

    name: str
    state: str
    reason: str = ""
    log: str = ""
    facts: dict[str, Any] | None = None  # of a survey that was done: seconds, transfer_s, peak_mb, host


class Watcher(Protocol):
    """Who waits for the survey."""

    def is_wanted(self) -> bool:
        """False once the survey shall end without results."""

    def tell(self, state: dict[str, Any]) -> None:
        """Takes where the survey stands, to be shown."""


# Surveys what lies in a folder (`recording/`, boq.yaml, board.yaml) into its `results/` and returns facts of it. Raises
# Refused, SurveyFailure or Unwanted.
Runner = Callable[[Task, Path, Watcher], dict[str, Any]]
