# SPDX-License-Identifier: Apache-2.0
"""The supervisor of the reconstruction's process: what a new process is given after a death."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.journal import Journal
from pipeprog_sfm.reconstruction import Status
from pipeprog_sfm.supervisor import MAX_BACKLOG, MAX_VAIN_STARTS, ReconstructionLostError, Supervisor
from pipeprog_sfm.worker import AddKeyframe, Command, Finish, Finished, KeyframeDone, Ready, Retire, Retired

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


class Process:
    """Takes commands and does nothing."""

    def __init__(self, answered: Iterable[Command]) -> None:
        self.answered = list(answered)
        self.sent: list[Command] = []
        self.backlog = 0

    def send(self, command: Command) -> None:
        self.sent.append(command)

    def close(self) -> None:
        pass


class Processes:
    """All that were started."""

    def __init__(self) -> None:
        self.started: list[Process] = []

    def __call__(self, answered: Iterable[Command]) -> Process:
        self.started.append(Process(answered))
        return self.started[-1]


def keyframe(stamp: int) -> AddKeyframe:
    return AddKeyframe(stamp, b"", CAMERA)


def done(stamp: int) -> KeyframeDone:
    return KeyframeDone(stamp, Status(), [], None)


@pytest.fixture
def processes() -> Processes:
    return Processes()


@pytest.fixture
def live(processes: Processes) -> Iterator[Supervisor]:
    supervisor = Supervisor(processes, Journal())
    yield supervisor
    supervisor.close()


def test_a_new_process_takes_what_was_answered_and_what_was_not_less_the_suspect(
    live: Supervisor, processes: Processes
) -> None:
    for stamp in (1, 2):
        live.send(keyframe(stamp))
        live.note(done(stamp))
    live.send(Retire((1,)))
    live.note(Retired(Status(), []))
    for stamp in (3, 4):
        live.send(keyframe(stamp))
    assert "takes its 3 commands again" in live.restart(-9)
    first, second = processes.started
    assert first.answered == []
    assert second.answered == [keyframe(1), keyframe(2), Retire((1,))]
    assert second.sent == [keyframe(4)], "the process may have died of the third keyframe"
    assert (live.done, live.dropped, live.retired) == (2, 1, 1)
    live.note(done(4))
    live.restart(-9)
    assert processes.started[-1].answered == [keyframe(1), keyframe(2), Retire((1,)), keyframe(4)]
    assert processes.started[-1].sent == []


def test_a_finish_without_answer_is_sent_again_and_an_answered_one_is_not(
    live: Supervisor, processes: Processes
) -> None:
    live.finish(Finish(colmap="here"))
    live.restart(1)
    assert processes.started[-1].sent == [Finish(colmap="here")]
    live.note(Finished(Status(), ""))
    live.restart(1)
    assert processes.started[-1].sent == []


def test_it_is_given_up_after_starts_in_vain(live: Supervisor) -> None:
    live.note(Ready())
    for _ in range(MAX_VAIN_STARTS):
        assert "started again" in live.restart(1)
        assert not live.ready
    with pytest.raises(ReconstructionLostError, match=r"exit code 1.*the map is lost"):
        live.restart(1)


def test_an_answer_makes_a_start_worth_while(live: Supervisor) -> None:
    for stamp in range(2 * MAX_VAIN_STARTS):
        live.restart(1)
        live.send(keyframe(stamp))
        live.note(done(stamp))


def test_without_a_journal_the_first_death_is_final(processes: Processes) -> None:
    with pytest.raises(ReconstructionLostError):
        Supervisor(processes, None).restart(-9)


def test_it_is_full_when_the_process_does_not_keep_up(live: Supervisor, processes: Processes) -> None:
    processes.started[0].backlog = MAX_BACKLOG - 1
    assert not live.is_full
    processes.started[0].backlog += 1
    assert live.is_full
