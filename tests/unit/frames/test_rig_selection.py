# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one robot: each one's frames are chosen as if it were alone, with one memory and one load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.errors import InputError
from pipeprog_camera.rig import unique_stamp
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import FULL
from pipeprog_frames.incoming.arrival import Arrival
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.rig_selection import RigSelection
from pipeprog_frames.selection import Selected, Selection
from tests.unit.frames.test_selection import CAMERA, START, STEP, chosen, reasons, shown, walk, wall

__all__ = ["wall"]
NAMES = ("left", "right", "back")


def rig_walk(wall: NDArray[np.uint8], count: int) -> list[Arrival]:
    """What three cameras see that are triggered together: the first two move, the third stands still."""
    streams = [walk(wall, count), walk(wall[:, ::-1], count), walk(wall, 1) * count]
    moments = zip(*streams, strict=True)
    return [
        replace(one, stamp=unique_stamp(START + moment * STEP, number), frame_id=f"{name}_optical", camera=name)
        for moment, together in enumerate(moments)
        for number, (name, one) in enumerate(zip(NAMES, together, strict=True))
    ]


def show(rig: RigSelection, arrivals: list[Arrival]) -> Selected:
    selected = []
    for each in arrivals:
        rig.calibrate(each.camera, each.stamp, CAMERA)
        selected += rig.consider(each)
    return selected


def test_each_camera_has_the_keyframes_that_it_would_have_alone(wall: NDArray[np.uint8]) -> None:
    arrivals = rig_walk(wall, 12)
    rig = RigSelection(FramesConfig(), NAMES)
    together = show(rig, arrivals) + rig.flush()
    stamps = [decision.stamp for decision, _ in together]
    assert sorted(stamps) == sorted(each.stamp for each in arrivals)  # one decision each, though three share a moment
    for name in NAMES:
        own = [replace(each, camera="") for each in arrivals if each.camera == name]
        alone = Selection(FramesConfig())
        expected = chosen(shown(alone, own) + alone.flush())
        assert chosen([each for each in together if each[0].frame_id == f"{name}_optical"]) == expected
    frames = {frame.stamp: frame.frame_id for _, frame in together if frame is not None}
    assert frames.keys() == set(chosen(together))
    assert all(frames[stamp] == f"{NAMES[(stamp - START) % STEP]}_optical" for stamp in frames)


def test_reports_correct_the_camera_that_they_are_of(wall: NDArray[np.uint8]) -> None:
    rig = RigSelection(FramesConfig(), NAMES)
    keyframes = chosen(show(rig, rig_walk(wall, 12)) + rig.flush())
    reports = [OverlapReport(stamp, (stamp - START) % STEP != 1, 0.99, 0.99, 400, 400) for stamp in keyframes]
    added = [decision for decision, _ in rig.answer(reports) if decision.chosen]
    assert added
    assert {(decision.stamp - START) % STEP for decision in added} == {1}
    assert {decision.frame_id for decision in added} == {"right_optical"}


def test_under_load_all_cameras_choose_fewer(wall: NDArray[np.uint8]) -> None:
    free, loaded = RigSelection(FramesConfig(), NAMES), RigSelection(FramesConfig(), NAMES)
    arrivals = rig_walk(wall, 24)
    before = [show(rig, arrivals[:9]) for rig in (free, loaded)]
    assert before[0] == before[1]
    loaded.lag(30)
    assert loaded.overlap_min < free.overlap_min == FramesConfig().overlap_min
    counts = [
        len(chosen([each for each in show(rig, arrivals[9:]) if each[0].stamp % 10 < 2])) for rig in (free, loaded)
    ]
    assert counts[1] < counts[0]


def test_the_cameras_share_what_the_map_may_hold(wall: NDArray[np.uint8]) -> None:
    arrivals = rig_walk(wall, 24)
    rig = RigSelection(FramesConfig(max_keyframes=8), NAMES)
    selected = show(rig, arrivals) + rig.flush()
    assert len(chosen(selected)) == rig.budget.held == 8
    left_out = [decision for decision, _ in selected if decision.reason == FULL]
    assert {decision.frame_id for decision in left_out} >= {"left_optical", "right_optical"}


def test_a_camera_without_calibration_is_named_and_the_others_go_on(wall: NDArray[np.uint8]) -> None:
    rig = RigSelection(FramesConfig(), NAMES)
    arrivals = rig_walk(wall, 6)
    selected = []
    for each in arrivals:
        if each.camera != "right":
            rig.calibrate(each.camera, each.stamp, CAMERA)
        assert rig.is_ready(each) == (each.camera != "right")
        selected += rig.consider(each)
    assert rig.uncalibrated == ["right"]
    refused = [stamp for stamp, reason in reasons(selected).items() if reason.startswith("calibration")]
    assert refused == [each.stamp for each in arrivals if each.camera == "right"]


def test_an_image_of_a_camera_that_is_none_of_the_rigs_is_refused(wall: NDArray[np.uint8]) -> None:
    rig = RigSelection(FramesConfig(), NAMES)
    stranger = replace(rig_walk(wall, 1)[0], camera="gripper", frame_id="gripper_optical")
    assert rig.is_ready(stranger)
    ((decision, frame),) = rig.consider(stranger)
    assert (decision.reason, decision.frame_id, frame) == (
        "calibration: the camera is none of the rig's",
        "gripper_optical",
        None,
    )


@pytest.mark.parametrize("names", [("left", "left"), tuple(map(str, range(65)))])
def test_names_that_cannot_be_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="name each once"):
        RigSelection(FramesConfig(), names)


def test_the_network_of_images_takes_one_camera() -> None:
    with pytest.raises(InputError, match="policy = stream"):
        RigSelection(FramesConfig(policy="network", lockstep=True), NAMES)
