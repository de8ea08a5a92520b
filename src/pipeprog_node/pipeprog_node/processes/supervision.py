# SPDX-License-Identifier: Apache-2.0
"""A worker process as its node sees it: commands in, and another worker when it dies, for all nodes alike.

A worker dies of the machine (killed from outside, no memory left) or of the command that it works on. So that command
is given to the next worker once more, and nothing is lost; the second death is the command's fault: it is dropped, and
its content is remembered, so that the same message coming again (latched topics do that) is not given to a worker.
"""

from __future__ import annotations

import hashlib
import pickle
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from pipeprog_node.processes.journal import Journal, Record

MAX_VAIN_DEATHS = 4  # in a row without an answer: two commands in a row that each kill two workers
MAX_DEATHS = 10  # within REST_SECONDS: a start a minute, each of which costs seconds, leaves time to work
REST_SECONDS = 600.0  # s without a worker after too many deaths: the time in which other programs give memory back


class Command(Protocol):
    """What a worker is told; picklable."""

    @property
    def content(self) -> object:
        """What of it came from outside and is recognised when it comes again; None: nothing."""


class Worker(Protocol):
    """What supervision needs of a process, as pipeprog_node.processes.worker.WorkerProcess."""

    def send(self, command: Any) -> None:
        """Queues a command; never blocks."""

    def close(self) -> None:
        """Ends the process."""


@dataclass(frozen=True)
class Death:
    """What came of the death of a worker.

    Attributes:
        report: what happened and what is done about it.
        dropped: the command that two workers have died of; None: the command in work is tried once more.
        failed: the request that will not be answered: it is the one dropped, or no worker is left.
    """

    report: str
    dropped: Command | None = None
    failed: Command | None = None


class Supervision:
    """Gives commands to a worker; starts another one when it dies, with all that the first one had.

    Commands are of three kinds: those to `keep` have no answer, those to `send` are answered in order (a worker gets
    either the ones or the others), a `request` is one at a time and asks for a result of all commands before it.
    What was kept or answered lies on disk for the next worker.

    Args:
        start: starts a worker that takes the commands of a record, which are answered already, before all others;
            it says when it is ready.
        name: of the worker in reports: "the reconstruction".
        clock: seconds.
        journal: of the commands; None: one that is gone with this process. What is in it already is taken up: the
            first worker gets it.

    Attributes:
        in_work: number of the command that the worker says it works on; None: the oldest without an answer.
        deaths: of workers.
        dropped: commands that workers died of.
    """

    def __init__(
        self,
        start: Callable[[Record], Worker],
        name: str,
        clock: Callable[[], float] = time.monotonic,
        journal: Journal | None = None,
    ) -> None:
        self._start, self._name, self._clock = start, name, clock
        self._journal = Journal() if journal is None else journal
        self._commands = self._journal.end  # given so far: the next number
        self._unanswered: dict[int, Command] = {number: self._journal.read(number) for number in self._journal.waiting}
        self._request: tuple[int, Command] | None = None
        self._deaths_of: Counter[int] = Counter()
        self._poisons: set[bytes] = set()
        self._recent_deaths: deque[float] = deque()
        self._vain_deaths = self._unsaved = self.deaths = self.dropped = 0
        self._rest_ends: float | None = None
        self.in_work: int | None = None
        self._ready = False
        self._worker: Worker | None = None
        self._begin()

    @property
    def is_ready(self) -> bool:
        """Whether commands are worked off without delay."""
        return self._ready

    @property
    def backlog(self) -> int:
        """Commands sent and not answered."""
        return len(self._unanswered)

    @property
    def takes_requests(self) -> bool:
        """Whether there is a worker, and no request that it has not answered."""
        return self._worker is not None and self._request is None

    @property
    def problem(self) -> str:
        """Why nothing is worked off now and what to do; empty: all is well."""
        if self._rest_ends is None:
            return ""
        rest = max(self._rest_ends - self._clock(), 0.0)
        return (
            f"{self._name} died {self.deaths} times and is started again in {rest:.0f} s: "
            "free memory, or see in this node's output what ended it"
        )

    def health(self) -> dict[str, Any]:
        """Numbers for the diagnostics."""
        values: dict[str, Any] = {"worker restarts": self.deaths}
        if self.dropped:
            values["dropped as the worker died of it"] = self.dropped
        if self._unsaved:
            values["not saved for a restart (no room in the temporary folder)"] = self._unsaved
        return values

    def is_poison(self, command: Command) -> bool:
        """Whether workers have died of the same content."""
        return bool(self._poisons) and command.content is not None and _digest(command) in self._poisons

    def keep(self, command: Command) -> int:
        """Gives a command that has no answer; returns its number."""
        return self._give(command, waits=False)

    def send(self, command: Command) -> None:
        """Gives a command that is answered, after those before it."""
        self._unanswered[self._give(command, waits=True)] = command

    def note(self, content: Any) -> None:
        """Notes in the journal what its reader is to know besides the commands."""
        self._save(partial(self._journal.write_note, content))

    def request(self, command: Command) -> None:
        """Asks for a result of all commands before this one."""
        self._request = (self._commands, command)
        self._commands += 1
        if self._worker is not None:
            self._worker.send(command)

    def ready(self) -> None:
        """The worker has taken what its predecessor had."""
        self._ready = True

    def answered(self) -> None:
        """The oldest command that was sent is answered."""
        number = next(iter(self._unanswered))
        del self._unanswered[number]
        self._save(partial(self._journal.answered, number))
        self._vain_deaths = 0

    def fulfilled(self) -> None:
        """The request is answered."""
        self._request = None
        self._vain_deaths = 0

    def restart(self, exit_code: int) -> Death:
        """Starts another worker after the death of this one, or later where too many have died."""
        now = self._clock()
        self.deaths += 1
        self._vain_deaths += 1
        self._recent_deaths.append(now)
        while now - self._recent_deaths[0] > REST_SECONDS:
            self._recent_deaths.popleft()
        dropped, failed = self._blame()
        died = f"{self._name} died (exit code {exit_code})"
        self._leave()
        if self._vain_deaths > MAX_VAIN_DEATHS or len(self._recent_deaths) > MAX_DEATHS:
            self._rest_ends = now + REST_SECONDS
            if self._request is not None:
                failed, self._request = self._request[1], None
            return Death(f"{died}: {self.problem}", dropped, failed)
        self._begin()
        again = "what it worked on is tried once more" if dropped is None else "without what it died of twice"
        return Death(f"{died}: it is started again, {again}", dropped, failed)

    def wake(self) -> None:
        """Starts a worker when the rest after too many deaths is over; to be called every second or so."""
        if self._rest_ends is not None and self._clock() >= self._rest_ends:
            self._rest_ends = None
            self._vain_deaths = 0
            self._recent_deaths.clear()
            self._begin()

    def close(self) -> None:
        """Ends the worker."""
        self._leave()
        self._journal.close()

    def _give(self, command: Command, waits: bool) -> int:
        number = self._commands
        self._commands += 1
        self._save(partial(self._journal.write, number, command, waits))
        if self._worker is not None:
            self._worker.send(command)
        return number

    def _save(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError:  # no room: a worker that dies then loses it, and this one goes on
            self._unsaved += 1

    def _blame(self) -> tuple[Command | None, Command | None]:
        """Drops the command in work where a worker has died of it before; returns it, and as request that fails."""
        number = self._suspect()
        if number is None:
            return None, None
        self._deaths_of[number] += 1
        if self._deaths_of[number] < 2:
            return None, None
        self.dropped += 1
        if self._request is not None and number == self._request[0]:
            command, self._request = self._request[1], None
            self._remember(command)
            return command, command
        command = self._unanswered.pop(number) if number in self._unanswered else self._journal.read(number)
        self._save(partial(self._journal.remove, number))
        self._remember(command)
        return command, None

    def _suspect(self) -> int | None:
        if not self._ready:
            return None  # it died of what its predecessor had survived, or of the machine
        if self.in_work is not None:
            return self.in_work
        return next(iter(self._unanswered), None if self._request is None else self._request[0])

    def _remember(self, command: Command) -> None:
        if command.content is not None:
            self._poisons.add(_digest(command))

    def _leave(self) -> None:
        if self._worker is not None:
            self._worker.close()
        self._worker, self._ready, self.in_work = None, False, None

    def _begin(self) -> None:
        self._worker = self._start(self._journal.record(next(iter(self._unanswered), self._commands)))
        for command in self._unanswered.values():
            self._worker.send(command)
        if self._request is not None:
            self._worker.send(self._request[1])


def _digest(command: Command) -> bytes:
    return hashlib.sha256(pickle.dumps(command.content)).digest()
