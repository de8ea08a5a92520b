# SPDX-License-Identifier: Apache-2.0
"""The reconstruction's process as its node sees it: commands in, and a new process when it dies."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from pipeprog_sfm.journal import Journal
from pipeprog_sfm.worker import AddKeyframe, Event, Finish, Finished, KeyframeDone, Ready, Retire, Retired

MAX_BACKLOG = 50  # commands that wait for the process; as deep as the keyframes' topic
MAX_VAIN_STARTS = 2  # starts in a row after which the process died before it answered anything


class ReconstructionLostError(Exception):
    """The process died and cannot be started again; the text says so."""


class Process(Protocol):
    """What the supervisor needs of a process, as pipeprog_node.worker.WorkerProcess."""

    @property
    def backlog(self) -> int:
        """Commands that the process has not taken yet."""

    def send(self, command: AddKeyframe | Retire | Finish) -> None:
        """Queues a command; never blocks."""

    def close(self) -> None:
        """Ends the process."""


class Supervisor:
    """Hands commands to the process and counts its answers; starts it again when it dies.

    Args:
        start: starts a process that takes these commands, which are answered already, before all others.
        journal: where commands are kept for a new process; None: the death of the process is final, as in a replay.

    Attributes:
        ready: whether keyframes are processed without delay.
        done: keyframes answered.
        dropped: keyframes that the process was not given as it was full, or that it died of.
        retired: Retire commands answered.
    """

    def __init__(self, start: Callable[[Iterable[AddKeyframe | Retire]], Process], journal: Journal | None) -> None:
        self._start, self._journal = start, journal
        self.ready = False
        self.done = self.dropped = self.retired = 0
        self._answered = 0  # commands of the journal
        self._vain_starts = 0
        self._finish: Finish | None = None  # sent and not answered
        self._process = start(())

    @property
    def backlog(self) -> int:
        """Commands that the process has not taken yet."""
        return self._process.backlog

    @property
    def is_full(self) -> bool:
        """Whether keyframes are to be dropped: the process does not keep up."""
        return self.backlog >= MAX_BACKLOG

    def send(self, command: AddKeyframe | Retire) -> None:
        """Hands a command to the process."""
        if self._journal is not None:
            self._journal.append(command)
        self._process.send(command)

    def finish(self, command: Finish) -> None:
        """Lets the process make the final map."""
        self._finish = command
        self._process.send(command)

    def note(self, event: Event) -> None:
        """Counts an answer of the process."""
        if isinstance(event, Ready):
            self.ready = True
            return
        self._vain_starts = 0
        self._answered += isinstance(event, KeyframeDone | Retired)
        self.done += isinstance(event, KeyframeDone)
        self.retired += isinstance(event, Retired)
        if isinstance(event, Finished):
            self._finish = None

    def restart(self, exit_code: int) -> str:
        """Starts the process again after its death, and returns what is to be reported.

        The keyframe that it was working on is dropped: it may be the cause. Raises ReconstructionLostError.
        """
        died = f"the reconstruction process died (exit code {exit_code})"
        self._vain_starts += 1
        if self._journal is None or self._vain_starts > MAX_VAIN_STARTS:
            raise ReconstructionLostError(f"{died}: the map is lost")
        self.ready = False
        suspect = next(iter(self._journal.record(self._answered, self._answered + 1)), None)
        if isinstance(suspect, AddKeyframe):
            self._journal.remove(self._answered)
            self.dropped += 1
        self._process = self._start(self._journal.record(0, self._answered))
        for command in self._journal.record(self._answered, len(self._journal)):
            self._process.send(command)
        if self._finish is not None:
            self._process.send(self._finish)
        return f"{died}: it is started again and takes its {self._answered} commands again"

    def close(self) -> None:
        """Ends the process."""
        self._process.close()
        if self._journal is not None:
            self._journal.close()
