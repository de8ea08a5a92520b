# SPDX-License-Identifier: Apache-2.0
"""What the node `survey` writes down of a survey, so that one that is started in its place can go on with it."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeprog_bringup.results.atomic_output import JOURNAL, left_behind
from pipeprog_bringup.survey.sign_of_life import is_alive, sign
from pipeprog_camera.errors import InputError
from pipeprog_node.processes.journal import Journal

_NAME = "survey.journal"
_LIFE = "survey.alive"  # the node's signs of life, beside its journal


@dataclass
class Progress:
    """How far a survey has come.

    Attributes:
        goal: the action's goal, in CDR.
        begun: how each of the other nodes has begun it; empty: not all have.
        filming: when filming began, of the clock `time.monotonic`, later by the pauses that are over; 0: not yet.
        paused: when the pause that lasts began, of that clock; 0: there is none.
        is_filmed: whether filming has ended.
    """

    goal: bytes
    begun: dict[str, dict[str, Any]] = field(default_factory=dict)
    filming: float = 0.0
    is_filmed: bool = False
    paused: float = 0.0

    @property
    def is_paused(self) -> bool:
        """Whether no images are taken, and will be again."""
        return self.paused > 0.0 and not self.is_filmed

    def filmed(self, now: float) -> float:
        """How long it has been filmed until the time `now` of `time.monotonic`, without pauses; s."""
        return (self.paused or now) - self.filming

    def pause(self, now: float) -> None:
        """Begins a pause, where there is none."""
        self.paused = self.paused or now

    def go_on(self, now: float) -> None:
        """Ends the pause, if there is one."""
        if self.paused and self.filming:
            self.filming += now - max(self.paused, self.filming)
        self.paused = 0.0


class SurveyJournal:
    """The progress of a survey, and the decisions on its frames (`frames`)."""

    def __init__(self, folder: Path, goal: bytes) -> None:
        """`folder`: that of the nodes' journals; `goal` is of a survey that begins. Raises InputError."""
        self._path, self._life = folder / _NAME, folder / _LIFE
        self.frames = Journal(self._path)
        self.progress: Progress = self.frames.note or Progress(goal)
        self.note()
        self.live()

    def note(self) -> None:
        """Writes the progress down."""
        with contextlib.suppress(OSError):  # the disk is full: the survey ends by that
            self.frames.write_note(self.progress)

    def live(self) -> None:
        """A sign of life, due every few seconds."""
        with contextlib.suppress(OSError):
            sign(self._life)

    def forget_nodes(self) -> None:
        """Removes what the other nodes have written: the survey begins once more."""
        for file in self._path.parent.glob("*.journal"):
            if file != self._path:
                file.unlink(missing_ok=True)

    def close(self) -> None:
        """Closes the file."""
        self.frames.close()


@dataclass(frozen=True)
class Unfinished:
    """A survey whose node was killed: its hidden folder and its goal, in CDR."""

    folder: Path
    goal: bytes


def unfinished(results: Path) -> Unfinished | None:
    """The survey in the folder `results` that was conducted a moment ago, and is not any more; None without one."""
    for survey in results.iterdir() if results.is_dir() else ():
        for folder in left_behind(survey):
            if not is_alive(folder / JOURNAL / _LIFE):
                continue
            with contextlib.suppress(InputError):
                journal = Journal(folder / JOURNAL / _NAME)
                journal.close()
                if isinstance(journal.note, Progress):
                    return Unfinished(folder, journal.note.goal)
    return None
