"""The loop of the process that reconstructs, beside a reconstruction that answers at once."""

import multiprocessing
import threading

import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm import worker
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


class Prompt:
    """Stands for a Reconstruction whose maps are there as soon as they are asked for."""

    def __init__(self, config: SfmConfig, board_file: BoardFile) -> None:
        self.is_mapping = False

    def add(self, *keyframe: object) -> None:
        pass

    def move(self, motion: object) -> None:
        pass

    def update_dense(self) -> None:
        pass

    def trajectory(self) -> str:
        return "poses"

    def status(self) -> str:
        return "well"

    def overlap_reports(self) -> list[object]:
        return []

    def request_map(self) -> None:
        self.is_mapping = True

    def finished_map(self) -> str | None:
        ready, self.is_mapping = self.is_mapping, False
        return "early map" if ready else None

    def finish(self) -> str:
        return "last map"


@pytest.fixture
def serving(monkeypatch):
    monkeypatch.setattr(worker, "Reconstruction", Prompt)
    monkeypatch.setattr(worker, "warm_up", lambda config: None)
    monkeypatch.setattr(worker, "IDLE_SECONDS", 0.3)
    ours, theirs = multiprocessing.Pipe()

    def run() -> None:
        with pytest.raises(EOFError):
            worker.serve(theirs, SfmConfig(), BoardFile(), ())

    thread = threading.Thread(target=run)
    thread.start()
    yield ours
    ours.close()
    thread.join(timeout=5.0)
    assert not thread.is_alive()


def received(connection, seconds: float) -> list[object]:
    events = []
    while connection.poll(seconds):
        events.append(connection.recv())
    return events


def keyframe() -> worker.AddKeyframe:
    return worker.AddKeyframe(1, np.zeros(3, np.uint8).tobytes(), CAMERA)


def test_no_map_follows_the_last_one(serving):
    serving.send(keyframe())
    serving.send(worker.Finish())
    events = received(serving, 1.0)
    assert [type(event) for event in events] == [worker.Ready, worker.KeyframeDone, worker.MapReady, worker.Finished]
    assert events[2].map == "last map"


def test_an_early_map_comes_when_no_keyframe_does(serving):
    serving.send(keyframe())
    events = received(serving, 1.0)
    assert [type(event) for event in events] == [worker.Ready, worker.KeyframeDone, worker.MapReady]
    assert events[2].map == "early map"
