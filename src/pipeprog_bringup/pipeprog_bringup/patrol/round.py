# SPDX-License-Identifier: Apache-2.0
"""A round of the robot: to each place that is not surveyed yet, past its pipes, and on."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pipeprog_bringup.patrol.patrol_file import Patrol, Place
from pipeprog_bringup.patrol.patrol_state import DONE, FAILED, FILMING, PatrolState
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown

ATTEMPTS = 2  # for a place in one round: the second when all others had theirs, as what stood in the way may be gone
KILL_SECONDS = 5.0  # s from asking a command to end to ending it


@dataclass(frozen=True)
class Surveyed:
    """What came of a survey: whether there are pipes; why not, or what else is to be said; the folder, if any."""

    succeeded: bool
    error: str
    folder: str


class Surveyor(Protocol):
    """The action `survey`, as a round needs it; one survey at a time."""

    def start(self, survey_id: str, boq: str, board: str, seconds: float, reference: str) -> None:
        """Begins to film, for `seconds` at most (0: no limit); raises InputError where the node does not take it."""

    def end(self) -> None:
        """Ends filming, if a survey is filmed, whoever has begun it."""

    def cancel(self) -> None:
        """Gives the survey up, if one runs."""

    def result(self) -> Surveyed:
        """Waits for the result of the survey."""

    @property
    def is_over(self) -> bool:
        """Whether no survey runs."""

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Waits until a condition holds, for `seconds` at most; returns whether it does."""


class Round:
    """Goes through the places that are not done, those that fail once more at the end.

    Args:
        patrol: the places.
        state: what is done; saved at every change.
        name: of the round: begins the name of each survey.
        surveyor: the action.
        report: gets a sentence at every change.
    """

    def __init__(
        self, patrol: Patrol, state: PatrolState, name: str, surveyor: Surveyor, report: Callable[[str], None]
    ) -> None:
        self._patrol, self._state, self._name = patrol, state, name
        self._surveyor, self._report = surveyor, report

    def run(self) -> list[str]:
        """Surveys what is left; returns the names of the places that have failed."""
        if any(place.state == FILMING for place in self._state.places.values()):
            self._surveyor.end()  # the program was killed while this place was filmed: it is surveyed once more
        waiting = deque(place for place in self._patrol.places if self._state.places[place.name].state != DONE)
        tries = dict.fromkeys((place.name for place in waiting), 0)
        filmed: Place | None = None
        try:
            while waiting or filmed:
                place = waiting.popleft() if waiting else None
                error = self._moved(place.go_to, place.move_seconds) if place else ""
                if filmed is not None:  # it was worked off while the robot went on
                    again = not self._settled(filmed) and tries[filmed.name] < ATTEMPTS
                    waiting += [filmed] if again else []
                    filmed = None
                if place is None:
                    continue
                tries[place.name] += 1
                filmed = place if not error and self._filmed(place) else None
                if filmed is None:
                    self._note(place, FAILED, error or self._state.places[place.name].error)
                    waiting += [place] if tries[place.name] < ATTEMPTS else []
            home = self._moved(self._patrol.home, max(place.move_seconds for place in self._patrol.places))
            if home:
                self._report(f"home: {home}")
        finally:
            self._surveyor.cancel()
        return [place.name for place in self._patrol.places if self._state.places[place.name].state != DONE]

    def _filmed(self, place: Place) -> bool:
        """Films a place; False where its survey has not begun."""
        of = self._state.places[place.name]
        of.attempts += 1
        of.survey_id = f"{self._name}_{place.name}" + (f"_{of.attempts}" if of.attempts > 1 else "")
        of.folder = of.error = ""
        self._note(place, FILMING, "")
        try:
            self._surveyor.start(of.survey_id, place.boq, place.board, place.seconds, place.reference)
        except InputError as error:
            of.error = str(error)
            return False
        if place.film:
            of.error = self._moved(place.film, place.seconds or place.move_seconds, while_filming=True)
        else:
            self._surveyor.wait(lambda: self._surveyor.is_over, place.seconds)
        self._surveyor.end()
        return True

    def _settled(self, place: Place) -> bool:
        """Notes the result of a place; returns whether it is done."""
        of = self._state.places[place.name]
        found = self._surveyor.result()
        of.folder = found.folder
        error = of.error or found.error
        succeeded = found.succeeded and not of.error  # of half a walk there may be pipes, and others are missing
        self._note(place, DONE if succeeded else FAILED, error)
        return succeeded

    def _note(self, place: Place, state: str, error: str) -> None:
        of = self._state.places[place.name]
        of.state, of.error = state, error
        self._state.save()
        where = f": {of.folder}" if state == DONE else ""
        self._report(f"{place.name}: {state}{where}" + (f" ({error})" if error else ""))

    def _moved(self, command: tuple[str, ...], seconds: float, while_filming: bool = False) -> str:
        """Runs a command to its end; returns why it has not moved the robot, empty: it has."""
        if not command:
            return ""
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            return f"{shown(command[0])} does not start: {error.strerror}"
        try:
            is_over = self._surveyor.wait(
                lambda: process.poll() is not None or (while_filming and self._surveyor.is_over), seconds
            )
        finally:
            running = process.poll() is None
            if running:
                _end(process)
        if running:
            return "" if is_over else f"{shown(command[0])} has not ended after {seconds:g} s"
        return f"{shown(command[0])} ended with {process.returncode}" if process.returncode else ""


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ends a command with all that it has started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(KILL_SECONDS)
            return
