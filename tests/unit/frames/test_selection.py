# SPDX-License-Identifier: Apache-2.0
"""What becomes of images that do not fit: other sizes, other clocks, no calibration; and of a camera that switches."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.incoming.arrival import Arrival
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.selection import Selected, Selection

CAMERA = Camera(320, 180, 225.0, 225.0, 159.5, 89.5)
LARGE = CAMERA.scaled(2.0)
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
STEP = SECOND // 5


@pytest.fixture(scope="module")
def wall() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).standard_normal((180, 2400)).astype(np.float32)
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 5.0, 15.0))
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def arrival(wall: NDArray[np.uint8], index: int, stamp: int, camera: Camera = CAMERA) -> Arrival:
    image = cv2.resize(wall[:, 20 * index : 20 * index + 320], (camera.width, camera.height))
    encoded = cv2.imencode(".jpg", image)[1].tobytes()
    size = camera.width, camera.height
    return Arrival(stamp, "camera", size, len(encoded), lambda: encoded, partial(decode_reduced, encoded, size[0]))


def shown(selection: Selection, arrivals: list[Arrival], camera: Camera = CAMERA) -> Selected:
    selected = []
    for each in arrivals:
        selection.calibrations.add(each.stamp, camera)
        selected += selection.consider(each)
    return selected


def walk(wall: NDArray[np.uint8], count: int, start: int = START, camera: Camera = CAMERA) -> list[Arrival]:
    return [arrival(wall, index, start + index * STEP, camera) for index in range(count)]


def chosen(selected: Selected) -> list[int]:
    return [decision.stamp for decision, _ in selected if decision.chosen]


def reasons(selected: Selected) -> dict[int, str]:
    return {decision.stamp: decision.reason for decision, _ in selected}


def never() -> bytes:
    raise AssertionError("an image of the wrong size was decoded")


@pytest.mark.parametrize("size", [(100_000, 100_000), (1, 1), (320, 181)])
def test_an_image_of_another_size_is_refused_before_it_is_decoded(
    wall: NDArray[np.uint8], size: tuple[int, int]
) -> None:
    good = walk(wall, 12)
    undisturbed = chosen(shown(Selection(FramesConfig()), good))
    bomb = Arrival(START + 5 * STEP + 1, "camera", size, 100, never, never)  # type: ignore[arg-type]
    selected = shown(Selection(FramesConfig()), [*good[:6], bomb, *good[6:]])
    assert reasons(selected)[bomb.stamp] == f"size differs from CameraInfo: {size[0]} x {size[1]}, not 320 x 180"
    assert chosen(selected) == undisturbed


def test_a_camera_that_switches_goes_on_with_its_calibration(wall: NDArray[np.uint8]) -> None:
    selection = Selection(FramesConfig())
    first = shown(selection, walk(wall, 12))
    switch = START + 12 * STEP
    second = shown(selection, walk(wall, 12, switch, LARGE), LARGE)
    back = shown(selection, walk(wall, 12, switch + 12 * STEP))
    selected = first + second + back + selection.flush()
    assert reasons(selected)[switch] == "first frame"
    assert sorted(reasons(selected)) == [START + index * STEP for index in range(36)], "each is decided on"
    assert len(selected) == 36
    keyframes = sorted((frame for _, frame in selected if frame is not None), key=lambda frame: frame.stamp)
    is_second = [switch <= frame.stamp < switch + 12 * STEP for frame in keyframes]
    assert [frame.camera.width == 640 for frame in keyframes] == is_second
    places = [[(stamp - start) // STEP for stamp in chosen(part)] for part, start in ((first, START), (second, switch))]
    assert places[1][: len(places[0])] == places[0], "the same walk at another size gives the same keyframes"


def test_reports_from_before_a_switch_are_still_used(wall: NDArray[np.uint8]) -> None:
    selection = Selection(FramesConfig())
    selected = shown(selection, walk(wall, 20)) + shown(selection, walk(wall, 20, START + 20 * STEP, LARGE), LARGE)
    reports = [OverlapReport(stamp, True, 0.95, 0.95, 500, 500) for stamp in chosen(selected)]
    reports[2] = OverlapReport(reports[2].stamp, True, 0.5, 0.5, 500, 100)
    added = chosen(selection.answer(reports))
    assert len(added) == 1
    assert reports[1].stamp < added[0] < reports[3].stamp


def test_after_one_absurd_stamp_keyframes_come_as_before(wall: NDArray[np.uint8]) -> None:
    good = walk(wall, 12)
    undisturbed = chosen(shown(Selection(FramesConfig()), good))
    absurd = arrival(wall, 3, START + 10**8 * SECOND)
    selected = shown(Selection(FramesConfig()), [*good[:6], absurd, *good[6:]])
    assert chosen(selected) == undisturbed
    assert reasons(selected)[absurd.stamp] == "stamp jumps ahead"


def test_after_an_absurd_first_stamp_keyframes_come_as_before(wall: NDArray[np.uint8]) -> None:
    good = walk(wall, 12)
    undisturbed = chosen(shown(Selection(FramesConfig()), good))
    absurd = arrival(wall, 3, START + 10**8 * SECOND)
    assert chosen(shown(Selection(FramesConfig()), [absurd, *good])) == [absurd.stamp, *undisturbed]


def test_after_the_clock_was_set_back_no_stamp_is_chosen_twice(wall: NDArray[np.uint8]) -> None:
    selection = Selection(FramesConfig())
    good = walk(wall, 12)
    first = shown(selection, good)
    again = shown(selection, good)
    assert not set(chosen(first)) & set(chosen(again))
    assert all(frame is not None for decision, frame in first + again if decision.chosen)
    assert reasons(again)[START] == "stamp repeats"


def test_an_image_without_calibration_is_named(wall: NDArray[np.uint8]) -> None:
    selected = Selection(FramesConfig()).consider(arrival(wall, 0, START))
    assert reasons(selected) == {START: "calibration: no usable CameraInfo has come"}


def test_an_image_that_decodes_to_another_size_than_its_header_declares_is_damaged(wall: NDArray[np.uint8]) -> None:
    lying = arrival(wall, 0, START)
    lying = Arrival(START, "camera", (320, 180), 1, lying.encode, lambda: np.zeros((90, 160), np.uint8))
    assert reasons(shown(Selection(FramesConfig()), [lying])) == {START: "damaged image"}


def test_a_network_begins_anew_where_the_clock_was_set(wall: NDArray[np.uint8]) -> None:
    selection = Selection(FramesConfig(policy="network", lockstep=True))
    selected = shown(selection, walk(wall, 11)) + shown(selection, walk(wall, 11, START - 100 * SECOND))
    assert chosen(selected) == [START, START + 10 * STEP, START - 100 * SECOND, START - 100 * SECOND + 10 * STEP]
