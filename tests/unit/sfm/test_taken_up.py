# SPDX-License-Identifier: Apache-2.0
"""An sfm node in place of one that was killed: what its journal holds is worked off once, and counted as before."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage

from pipeprog_camera.camera import Camera
from pipeprog_msgs.msg import ImageOverlapArray, KeyframesRetired
from pipeprog_node import messages, qos
from pipeprog_node.processes.journal import Journal
from pipeprog_sfm import node as sfm
from pipeprog_sfm.reconstruction import Status
from pipeprog_sfm.worker import AddKeyframe, KeyframeDone, Ready, Retire, Retired

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
ENCODED = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
START = 1_700_000_000_000_000_000  # ns
TIMEOUT = 60.0  # s, for what takes a tenth on an idle machine


class Worker:
    """Stands for the reconstruction's process: takes commands, and answers when it is told to."""

    started: list[Worker]

    def __init__(self, node: Node, serve: Any, arguments: tuple[Any, ...], on_event: Callable[..., None], *_: Any):
        self.record, self.answer = list(arguments[-1]), on_event
        self.sent: list[Any] = []
        Worker.started.append(self)

    def send(self, command: Any) -> None:
        self.sent.append(command)

    def close(self) -> None:
        pass


@pytest.fixture
def selector() -> Iterator[Node]:
    rclpy.init()
    Worker.started = []
    node = Node("selector")
    yield node
    node.destroy_node()
    rclpy.shutdown()


def keyframe(number: int) -> AddKeyframe:
    return AddKeyframe(START + number, ENCODED, CAMERA, "camera")


def test_a_survey_goes_on_where_it_was(selector: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path / "sfm.journal")
    for number in range(4):
        journal.write(number, keyframe(number), waits=True)
    journal.write(4, Retire((START + 1,)), waits=True)
    for number in range(3):
        journal.answered(number)
    journal.write_note((1, 5, START + 3))  # one keyframe was dropped, and five maps have come
    journal.close()

    images = selector.create_publisher(CompressedImage, "keyframes/image/compressed", qos.kept(50))
    infos = selector.create_publisher(CameraInfo, "keyframes/camera_info", qos.kept(50))
    retired = selector.create_publisher(KeyframesRetired, "keyframes/retired", qos.kept(50))
    for number in range(2, 6):  # two that were published while nobody was there
        images.publish(messages.compressed_image(START + number, "camera", ENCODED))
        infos.publish(messages.info_from_camera(CAMERA, START + number, "camera"))
    stamps = [messages.time_msg(START + 1)]
    retired.publish(KeyframesRetired(keyframes_published=3, stamps=stamps, header=messages.header(START + 3, "camera")))
    heard: list[ImageOverlapArray] = []
    selector.create_subscription(ImageOverlapArray, "image_overlap", heard.append, qos.kept(50))

    monkeypatch.setattr(sfm, "WorkerProcess", Worker)
    node = sfm.SfmNode([rclpy.Parameter("journal", value=str(tmp_path))])
    executor = SingleThreadedExecutor()
    for each in (selector, node):
        executor.add_node(each)

    def spin_until(condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            executor.spin_once(timeout_sec=0.02)

    (worker,) = Worker.started
    assert [command.stamp for command in worker.record] == [START, START + 1, START + 2]
    spin_until(lambda: len(worker.sent) >= 4)
    assert worker.sent[1] == Retire((START + 1,))  # once
    assert [each.stamp for each in worker.sent if isinstance(each, AddKeyframe)] == [START + 3, START + 4, START + 5]
    worker.answer(Ready())
    worker.answer(KeyframeDone(START + 3, "camera", Status(), [], None))
    worker.answer(Retired(Status(), []))
    spin_until(lambda: len(heard) == 3)
    # Three were answered and one dropped before.
    assert [(each.keyframes_considered, each.retirements_considered) for each in heard] == [(4, 0), (5, 0), (5, 1)]
    assert node._output.revision == 5
    executor.shutdown()
    node.destroy_node()
