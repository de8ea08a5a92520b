# SPDX-License-Identifier: Apache-2.0
"""The loop of the reconstruction's process, with a reconstruction that answers at once and a scripted connection."""

from __future__ import annotations

from multiprocessing import Pipe
from typing import Any, cast

import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm import worker
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.inbox import Inbox
from pipeprog_sfm.reconstruction import NotMetricError
from pipeprog_sfm.worker import ANSWER_SECONDS, HOLD_SECONDS, IDLE_SECONDS, POLL_SECONDS

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
KEYFRAME = worker.AddKeyframe(1, b"", CAMERA)
MAP_INTERVAL = 3


class Prompt:
    """Stands for a Reconstruction whose maps are there at once, or the `looks`-th time that they are looked for."""

    def __init__(self, metric_after: int = 0, looks: int = 1) -> None:
        self.looks, self.looked = looks, 0
        self.is_mapping = False
        self.keyframes: list[int] = []
        self.settled = False
        self.metric_after = metric_after  # keyframes

    def add(self, stamp: int, *keyframe: object) -> None:
        self.keyframes.append(stamp)

    def move(self, motion: object) -> None:
        pass

    def retire(self, stamps: tuple[int, ...]) -> None:
        self.keyframes = [stamp for stamp in self.keyframes if stamp not in stamps]

    def update_dense(self) -> None:
        pass

    def trajectory(self) -> str:
        return "poses"

    def status(self) -> str:
        return "well"

    def overlap_reports(self) -> list[object]:
        return []

    def request_map(self, settled: bool) -> None:
        if len(self.keyframes) < self.metric_after:
            raise NotMetricError
        self.is_mapping, self.settled = True, settled

    def finished_map(self) -> str | None:
        self.looked += self.is_mapping
        if self.looked < self.looks:
            return None
        self.looked = 0
        ready, self.is_mapping = self.is_mapping, False
        return ("settled map" if self.settled else "early map") if ready else None

    def finish(self) -> str:
        return "last map"


class Script:
    """A connection that delivers commands; a float in their place is a silence of that length in seconds.

    It closes when the loop waits for more. `cost` [s]: what the loop spends on each keyframe.
    """

    def __init__(self, *steps: worker.Command | float, cost: float = 0.0) -> None:
        self._steps = list(steps)
        self._cost = cost
        self.now = 0.0
        self.events: list[Any] = []

    def poll(self, timeout: float | None) -> bool:
        left = timeout
        while self._steps and isinstance(self._steps[0], float):
            waited = self._steps[0] if left is None else min(self._steps[0], left)
            self.now += waited
            self._steps[0] -= waited
            if self._steps[0] <= 0:
                self._steps.pop(0)
            if left is not None:
                left -= waited
                if left <= 0:
                    return False
        return bool(self._steps) or timeout != 0.0

    def recv(self) -> Any:
        if not self._steps:
            raise EOFError
        return self._steps.pop(0)

    def send(self, event: object) -> None:
        self.events.append(event)
        if isinstance(event, worker.KeyframeDone):
            self._spend(self._cost)

    def _spend(self, seconds: float) -> None:
        """Lets time pass, in which silences do, too."""
        self.now += seconds
        for place, step in enumerate(self._steps):
            if isinstance(step, float):
                self._steps[place] = max(step - seconds, 0.0)
                seconds = max(seconds - step, 0.0)


def events(
    *steps: worker.Command | float,
    answered: tuple[worker.AddKeyframe, ...] = (),
    map_interval: int | None = MAP_INTERVAL,
    metric_after: int = 0,
    looks: int = 1,
    cost: float = 0.0,
) -> list[Any]:
    """What the loop sends until the connection closes."""
    script = Script(*steps, cost=cost)
    with pytest.raises(EOFError):
        worker.work(script, cast(Any, Prompt(metric_after, looks)), map_interval, answered, lambda: script.now)
    return script.events


@pytest.mark.parametrize(
    ("ahead", "intermediate", "expected"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_replay_alone_is_read_ahead(
    ahead: bool, intermediate: bool, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Live, the other cores make depth maps and find pipes, and the first keyframe waits for nothing to be loaded."""
    channels: list[object] = []
    warm: list[SfmConfig] = []
    monkeypatch.setattr(worker, "warm_up", warm.append)
    monkeypatch.setattr(worker, "work", lambda channel, *others: channels.append(channel))
    connection = Pipe()[1]
    worker.serve(connection, SfmConfig(), BoardFile(), intermediate, None, ahead, ())
    assert isinstance(channels[0], Inbox) == expected
    assert len(warm) == intermediate


def test_no_map_follows_the_last_one() -> None:
    sent = events(KEYFRAME, worker.Finish(), 10 * IDLE_SECONDS, worker.Retire((1,)))
    kinds = [worker.Ready, worker.KeyframeDone, worker.MapReady, worker.Finished, worker.Retired]
    assert [type(event) for event in sent] == kinds
    assert sent[2].map == "last map"


def test_a_map_of_all_there_is_comes_when_no_keyframe_does() -> None:
    sent = events(KEYFRAME, IDLE_SECONDS + 3 * POLL_SECONDS)
    assert [type(event) for event in sent] == [worker.Ready, worker.KeyframeDone, worker.MapReady]
    assert sent[2].map == "settled map"


def test_no_early_map_comes_while_keyframes_do() -> None:
    sent = events(KEYFRAME, 0.9 * IDLE_SECONDS, KEYFRAME, 0.9 * IDLE_SECONDS)
    assert [type(event) for event in sent] == [worker.Ready, worker.KeyframeDone, worker.KeyframeDone]


def test_a_map_comes_after_each_interval_of_keyframes() -> None:
    sent = events(*[KEYFRAME] * (MAP_INTERVAL + 1))
    done = [worker.KeyframeDone] * MAP_INTERVAL
    assert [type(event) for event in sent] == [worker.Ready, *done, worker.KeyframeDone, worker.MapReady]
    assert sent[-1].map == "early map"


def test_the_first_map_comes_with_the_keyframe_that_measures_the_scale() -> None:
    sent = events(*[KEYFRAME] * (MAP_INTERVAL + 2), metric_after=MAP_INTERVAL + 1)
    assert [type(event) for event in sent[-2:]] == [worker.KeyframeDone, worker.MapReady]
    assert len(sent) == 1 + MAP_INTERVAL + 2 + 1


def test_after_a_map_at_the_last_keyframe_comes_one_of_all_there_is() -> None:
    sent = events(*[KEYFRAME] * MAP_INTERVAL, 10 * IDLE_SECONDS)
    assert [event.map for event in sent[1 + MAP_INTERVAL :]] == ["early map", "settled map"]


def test_a_map_that_is_finished_in_a_silence_waits_for_the_next_keyframe() -> None:
    looks = round(0.7 * IDLE_SECONDS / POLL_SECONDS)
    assert HOLD_SECONDS < 0.6 * IDLE_SECONDS
    walk = [KEYFRAME] * MAP_INTERVAL
    sent = events(*walk, 0.9 * IDLE_SECONDS, KEYFRAME, 0.1 * IDLE_SECONDS, looks=looks)
    assert [type(event) for event in sent[1 + MAP_INTERVAL :]] == [worker.MapReady, worker.KeyframeDone]
    assert sent[-2].map == "early map"
    sent = events(*walk, 10 * IDLE_SECONDS, looks=looks)
    assert [event.map for event in sent[1 + MAP_INTERVAL :]] == ["settled map"]
    sent = events(*walk, 0.9 * IDLE_SECONDS, worker.Finish(), 10 * IDLE_SECONDS, looks=looks)
    assert [type(event) for event in sent[1 + MAP_INTERVAL :]] == [worker.MapReady, worker.Finished]
    assert sent[-2].map == "last map"


def test_once_the_camera_rests_the_only_map_is_that_of_all_keyframes() -> None:
    waiting = [KEYFRAME] * (3 * MAP_INTERVAL)
    sent = events(*waiting, 10 * IDLE_SECONDS, cost=HOLD_SECONDS)
    assert [type(event) for event in sent] == [worker.Ready, *[worker.KeyframeDone] * len(waiting), worker.MapReady]
    assert sent[-1].map == "settled map"


def test_while_the_camera_walks_maps_come_although_keyframes_wait() -> None:
    walk: list[worker.Command | float] = [KEYFRAME, KEYFRAME, 0.5 * HOLD_SECONDS] * (2 * MAP_INTERVAL)
    sent = events(*walk, cost=HOLD_SECONDS)
    assert [event.map for event in sent if isinstance(event, worker.MapReady)][:1] == ["early map"]


def test_the_map_of_all_waits_for_what_follows_from_the_last_keyframe() -> None:
    cost = 2 * IDLE_SECONDS
    sent = events(KEYFRAME, cost + 0.5 * ANSWER_SECONDS, worker.Retire((1,)), 10 * IDLE_SECONDS, cost=cost)
    kinds = [worker.Ready, worker.KeyframeDone, worker.Retired, worker.MapReady]
    assert [type(event) for event in sent] == kinds


def test_a_camera_at_rest_without_a_scale_is_not_asked_again() -> None:
    sent = events(KEYFRAME, 10 * IDLE_SECONDS, metric_after=2)
    assert [type(event) for event in sent] == [worker.Ready, worker.KeyframeDone]


def test_without_an_interval_the_last_map_is_the_only_one_and_no_poses_come_before() -> None:
    sent = events(*[KEYFRAME] * 4, 10 * IDLE_SECONDS, worker.Finish(), map_interval=None)
    kinds = [worker.Ready, *[worker.KeyframeDone] * 4, worker.MapReady, worker.Finished]
    assert [type(event) for event in sent] == kinds
    assert sent[-2].map == "last map"
    assert [event.trajectory for event in sent if isinstance(event, worker.KeyframeDone)] == [None] * 4


def test_what_a_predecessor_answered_is_not_answered_again() -> None:
    assert [type(event) for event in events(KEYFRAME, answered=(KEYFRAME,))] == [worker.Ready, worker.KeyframeDone]
