# SPDX-License-Identifier: Apache-2.0
"""The sfm node when its worker dies: what is left out is counted as answered, so that a replay goes on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import pytest
import rclpy

from pipeprog_camera.camera import Camera
from pipeprog_node.processes.supervision import MAX_VAIN_DEATHS
from pipeprog_sfm import node as sfm
from pipeprog_sfm.reconstruction import Status
from pipeprog_sfm.worker import AddKeyframe, Finish, KeyframeDone, Ready, Retire

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


class Idle:
    """Stands for a worker; takes commands and does nothing."""

    def __init__(self, node: object, serve: object, arguments: tuple[Any, ...], *callbacks: object) -> None:
        self.ahead: bool = arguments[-2]
        self.record: Iterable[AddKeyframe | Retire] = arguments[-1]
        self.sent: list[object] = []

    def send(self, command: object) -> None:
        self.sent.append(command)

    def close(self) -> None:
        pass


class Replay:
    """The node in lockstep, and what it answers: keyframes and retirements considered."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sfm, "WorkerProcess", Idle)
        rclpy.init(args=["--ros-args", "--log-level", "fatal", "-p", "lockstep:=true"])
        self.node = sfm.SfmNode()
        self.answers: list[tuple[int, int]] = []
        monkeypatch.setattr(
            self.node._output,
            "publish_overlap",
            lambda header, reports, keyframes, retired, readout: self.answers.append((keyframes, retired)),
        )
        self.node._on_event(Ready())

    @property
    def worker(self) -> Any:
        return self.node._supervision._worker

    def keyframe(self, stamp: int, encoded: bytes) -> None:
        self.node._on_keyframe(stamp, encoded, CAMERA, "camera")

    def die(self) -> None:
        self.node._on_death(-11)
        self.node._on_event(Ready())


@pytest.fixture
def replay(monkeypatch: pytest.MonkeyPatch) -> Iterator[Replay]:
    replay = Replay(monkeypatch)
    yield replay
    replay.node.destroy_node()
    rclpy.try_shutdown()


def test_a_keyframe_that_kills_is_left_out_and_the_rest_is_worked_off(replay: Replay) -> None:
    for stamp, encoded in ((1, b"good"), (2, b"kills"), (3, b"good, too")):
        replay.keyframe(stamp, encoded)
    replay.node._on_event(KeyframeDone(1, "camera", Status(), [], None))
    replay.die()
    assert [command.stamp for command in replay.worker.sent] == [2, 3], "it may have been killed from outside"
    replay.die()
    assert [command.stamp for command in replay.worker.record] == [1]
    assert [command.stamp for command in replay.worker.sent] == [3]
    assert replay.answers == [(1, 0), (2, 0)]
    replay.keyframe(4, b"kills")
    assert [command.stamp for command in replay.worker.sent] == [3]
    assert replay.answers[-1] == (3, 0)


def test_only_the_first_worker_prepares_images_ahead(replay: Replay) -> None:
    """The first death may be of an image that was not in work yet; then the one in work is not left out for it."""
    assert replay.worker.ahead
    for stamp, encoded in ((1, b"good"), (2, b"kills")):
        replay.keyframe(stamp, encoded)
    replay.die()
    assert not replay.worker.ahead
    assert [command.stamp for command in replay.worker.sent] == [1, 2]
    replay.node._on_event(KeyframeDone(1, "camera", Status(), [], None))
    replay.die()
    assert not replay.worker.ahead
    assert [command.stamp for command in replay.worker.sent] == [2]


def test_a_last_map_that_kills_is_answered_with_the_reason(replay: Replay, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[str] = []
    monkeypatch.setattr(replay.node._finish, "answer", lambda outputs, problem: answers.append(problem))
    replay.node._supervision.request(Finish())
    replay.die()
    assert answers == []
    replay.die()
    assert "died (exit code -11)" in answers[0]


def test_a_replay_whose_worker_dies_again_and_again_ends(replay: Replay) -> None:
    for _ in range(MAX_VAIN_DEATHS):
        replay.node._on_death(-9)
    with pytest.raises(SystemExit):
        replay.node._on_death(-9)
