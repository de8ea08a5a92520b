# SPDX-License-Identifier: Apache-2.0
"""The supervision of a worker: what another one is given after a death, and what is not given again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeprog_node.processes.journal import Journal
from pipeprog_node.processes.supervision import MAX_DEATHS, MAX_VAIN_DEATHS, REST_SECONDS, Supervision


@dataclass(frozen=True)
class Step:
    """A command; `stamp` tells two of the same content apart."""

    content: bytes | None
    stamp: int = 0


FIRST, SECOND, THIRD, FOURTH = (Step(name.encode()) for name in ("first", "second", "third", "fourth"))
END = Step(None)


class Worker:
    """Takes commands and does nothing."""

    def __init__(self, record: Iterable[Step]) -> None:
        self.record = list(record)
        self.sent: list[Step] = []
        self.is_closed = False

    def send(self, command: Step) -> None:
        self.sent.append(command)

    def close(self) -> None:
        self.is_closed = True


class Stage:
    """All workers that were started, and the time [s]."""

    def __init__(self, journal: Journal | None = None) -> None:
        self.workers: list[Worker] = []
        self.now = 0.0
        self.supervision = Supervision(self.start, "the worker", lambda: self.now, journal)
        self.supervision.ready()

    def start(self, record: Iterable[Step]) -> Worker:
        self.workers.append(Worker(record))
        return self.workers[-1]

    def die(self) -> str:
        """A worker that was ready is killed; what is reported."""
        report = self.supervision.restart(-9).report
        self.supervision.ready()
        return report


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.supervision.close()
    assert stage.workers[-1].is_closed


def test_a_worker_killed_from_outside_loses_nothing(stage: Stage) -> None:
    for command in (FIRST, SECOND, THIRD, FOURTH):
        stage.supervision.send(command)
    for _ in range(2):
        stage.supervision.answered()
    stage.supervision.request(END)
    assert "died (exit code -9): it is started again, what it worked on is tried once more" in stage.die()
    assert stage.workers[0].is_closed
    assert stage.workers[1].record == [FIRST, SECOND]
    assert stage.workers[1].sent == [THIRD, FOURTH, END]
    for _ in range(2):
        stage.supervision.answered()
    stage.supervision.fulfilled()
    stage.die()
    assert (stage.workers[2].record, stage.workers[2].sent) == ([FIRST, SECOND, THIRD, FOURTH], [])
    assert (stage.supervision.deaths, stage.supervision.dropped) == (2, 0)


def test_what_two_workers_died_of_is_not_given_again(stage: Stage) -> None:
    for command in (FIRST, SECOND, THIRD):
        stage.supervision.send(command)
    stage.supervision.answered()
    stage.die()
    death = stage.supervision.restart(-11)
    assert (death.dropped, death.failed) == (SECOND, None)
    assert "exit code -11" in death.report
    assert (stage.workers[2].record, stage.workers[2].sent) == ([FIRST], [THIRD])
    assert stage.supervision.is_poison(Step(SECOND.content, stamp=77)), "the same content comes again"
    assert not stage.supervision.is_poison(THIRD)
    assert not stage.supervision.is_poison(END)
    assert stage.supervision.health()["dropped as the worker died of it"] == 1


def test_kept_commands_are_blamed_when_the_worker_says_that_it_works_on_them(stage: Stage) -> None:
    numbers = [stage.supervision.keep(command) for command in (FIRST, SECOND, THIRD)]
    stage.supervision.request(END)
    assert not stage.supervision.takes_requests
    for _ in range(2):
        stage.supervision.in_work = numbers[1]
        death = stage.supervision.restart(-11)
        stage.supervision.ready()
    assert (death.dropped, death.failed) == (SECOND, None)
    assert (stage.workers[-1].record, stage.workers[-1].sent) == ([FIRST, THIRD], [END])


def test_a_request_that_two_workers_died_of_fails(stage: Stage) -> None:
    stage.supervision.keep(FIRST)
    stage.supervision.request(SECOND)
    stage.die()
    assert stage.workers[-1].sent == [SECOND]
    death = stage.supervision.restart(1)
    assert (death.dropped, death.failed) == (SECOND, SECOND)
    assert (stage.workers[-1].record, stage.workers[-1].sent) == ([FIRST], [])
    assert stage.supervision.takes_requests
    assert stage.supervision.is_poison(Step(SECOND.content, 8))


def test_a_death_before_the_worker_is_ready_is_no_fault_of_a_command(stage: Stage) -> None:
    stage.supervision.send(FIRST)
    for _ in range(MAX_VAIN_DEATHS):
        stage.supervision.restart(-9)
        assert stage.workers[-1].sent == [FIRST]
    assert stage.supervision.dropped == 0


def test_after_too_many_deaths_in_vain_it_rests(stage: Stage) -> None:
    stage.supervision.request(END)
    for _ in range(MAX_VAIN_DEATHS):
        assert stage.supervision.restart(1).failed is None
    death = stage.supervision.restart(1)
    assert death.failed == END
    assert "free memory" in death.report
    assert "600 s" in stage.supervision.problem
    assert not stage.supervision.takes_requests
    started = len(stage.workers)
    stage.supervision.send(FIRST)
    stage.now += REST_SECONDS - 1.0
    stage.supervision.wake()
    assert len(stage.workers) == started
    stage.now += 1.0
    stage.supervision.wake()
    assert stage.workers[-1].sent == [FIRST]
    assert stage.supervision.problem == ""


def test_answers_between_deaths_do_not_make_it_spin(stage: Stage) -> None:
    for number in range(MAX_DEATHS):
        stage.supervision.send(Step(b"", number))
        stage.supervision.answered()
        stage.die()
        stage.now += 1.0
    assert not stage.supervision.problem
    stage.die()
    assert stage.supervision.problem


def test_deaths_long_ago_do_not_count(stage: Stage) -> None:
    for number in range(3 * MAX_DEATHS):
        stage.supervision.send(Step(b"", number))
        stage.supervision.answered()
        stage.die()
        stage.now += REST_SECONDS / (MAX_DEATHS - 1)
    assert not stage.supervision.problem


def test_a_full_disk_costs_what_is_not_written_and_no_node(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    stage.supervision.send(FIRST)
    stage.supervision.answered()
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "write", full)
        stage.supervision.send(SECOND)
        stage.supervision.send(THIRD)
    assert stage.workers[0].sent == [FIRST, SECOND, THIRD]
    stage.supervision.answered()
    stage.die()
    assert (stage.workers[1].record, stage.workers[1].sent) == ([FIRST], [THIRD])
    assert any("no room" in name for name in stage.supervision.health())


def test_a_process_in_place_of_one_that_was_killed_takes_up_its_journal(tmp_path: Path) -> None:
    killed = Stage(Journal(tmp_path / "journal"))
    killed.supervision.keep(FIRST)
    for command in (SECOND, THIRD, FOURTH):
        killed.supervision.send(command)
    killed.supervision.answered()
    killed.supervision.note("a note")
    journal = Journal(tmp_path / "journal")
    after = Stage(journal)
    assert (after.workers[0].record, after.workers[0].sent) == ([FIRST, SECOND], [THIRD, FOURTH])
    assert (after.supervision.backlog, journal.note) == (2, "a note")
    after.supervision.answered()
    assert after.supervision.keep(END) == 4
    after.die()
    assert (after.workers[1].record, after.workers[1].sent) == ([FIRST, SECOND, THIRD], [FOURTH])


def full(journal: Journal, number: int, command: Step, waits: bool) -> None:
    raise OSError("no space left on device")
