# SPDX-License-Identifier: Apache-2.0
"""The loop of the reconstruction's process, given keyframes that cannot be used: each is skipped with its reason."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.reconstruction import Reconstruction
from pipeprog_sfm.worker import AddKeyframe, Command, Finish, Finished, KeyframeDone, Retire, Retired, work

WIDTH, HEIGHT = 240, 160
CAMERA = Camera(WIDTH, HEIGHT, 220.0, 220.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
SECOND = 1_000_000_000
WALL = cv2.resize(
    np.random.default_rng(0).integers(0, 256, (HEIGHT // 4, WIDTH), np.uint8),
    (4 * WIDTH, HEIGHT),
    interpolation=cv2.INTER_CUBIC,
)


def encoded(image: np.ndarray, ending: str = ".png") -> bytes:
    return cv2.imencode(ending, image)[1].tobytes()


def good(place: int) -> AddKeyframe:
    view = np.ascontiguousarray(WALL[:, 16 * place :][:, :WIDTH])
    return AddKeyframe(place * SECOND, encoded(view), CAMERA, "camera")


class Script:
    """A connection that delivers commands, then closes."""

    def __init__(self, commands: list[Command]) -> None:
        self._commands: Iterator[Command] = iter(commands)
        self.events: list[Any] = []

    def poll(self, timeout: float | None) -> bool:
        return True

    def recv(self) -> Command:
        command = next(self._commands, None)
        if command is None:
            raise EOFError
        return command

    def send(self, event: Any) -> None:
        self.events.append(event)


def events(*commands: Command) -> list[Any]:
    script = Script(list(commands))
    with pytest.raises(EOFError):
        work(script, Reconstruction(SfmConfig(), BoardFile()), 1000, ())
    return script.events


PNG = encoded(np.zeros((HEIGHT, WIDTH), np.uint8))
JPEG = encoded(np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), np.uint8), ".jpg")
LARGE = PNG[:16] + (100_000).to_bytes(4, "big") * 2 + PNG[24:]  # its header says 100000 x 100000


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"no image at all", "neither JPEG nor PNG"),
        (LARGE, "JPEG nor PNG|too large"),
        (PNG[:60], "JPEG nor PNG|damaged"),
        (JPEG[:20], "JPEG nor PNG|damaged"),
        (encoded(np.zeros((HEIGHT, WIDTH + 2), np.uint8)), "CameraInfo says"),
    ],
    ids=["empty", "text", "bomb", "cut PNG", "cut JPEG", "another size"],
)
def test_an_image_that_cannot_be_used_is_skipped_with_its_reason(data: bytes, words: str) -> None:
    _, done = events(AddKeyframe(7, data, CAMERA, "camera"))
    assert isinstance(done, KeyframeDone)
    assert done.status.message.startswith("keyframe 7: ")
    assert any(word in done.status.message for word in words.split("|"))


def test_images_that_show_nothing_leave_the_map_as_it_is() -> None:
    rng = np.random.default_rng(2)
    nothing = [
        np.zeros((HEIGHT, WIDTH), np.uint8),
        np.full((HEIGHT, WIDTH, 3), 255, np.uint8),
        rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8),
        np.tile(np.arange(WIDTH) // 4 % 2 * 255, (HEIGHT, 1)).astype(np.uint8),
    ]
    hostile = [AddKeyframe(100 * SECOND + n, encoded(image), CAMERA) for n, image in enumerate(nothing)]
    commands = [command for place, one in enumerate(hostile) for command in (good(place), one)]
    *_, last, finished = events(*commands, good(len(hostile)), Finish())
    assert last.status.registered == len(hostile) + 1
    assert isinstance(finished, Finished)
    assert "nothing tells the scale" in finished.problem


def test_a_keyframe_that_comes_twice_is_skipped() -> None:
    first, second, third = good(0), good(1), good(2)
    _, *done = events(first, second, third, second, third, Retire((SECOND, SECOND, 5)), second)
    assert isinstance(done[5], Retired)
    assert [event.status.registered for event in done] == [0, 2, 3, 3, 3, 2, 3]
    assert "has been taken already" in done[3].status.message


def test_stamps_in_any_order_and_far_apart_are_taken() -> None:
    last = (2**31 - 2) * SECOND
    stamps = [last, 0, 5, last - 1, last // 2]
    commands = [AddKeyframe(stamp, good(n).encoded, CAMERA) for n, stamp in enumerate(stamps)]
    assert events(*commands)[-1].status.registered == len(stamps)
