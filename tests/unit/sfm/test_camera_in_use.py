# SPDX-License-Identifier: Apache-2.0
"""When a survey goes on with a refined camera, and what it says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.camera_in_use import FIRST_CHECK, CameraInUse, board_agrees, radial_warning
from pipeprog_sfm.config import CalibrationConfig
from pipeprog_sfm.sparse.self_calibration import RADII, Refinement, changed

TOLD = Camera(848, 480, 600.0, 600.0, 423.5, 239.5)
SIGMAS = np.array([0.0003, 0.0002, np.inf])


def found(changes: list[float], shift: float, told: Camera = TOLD) -> Refinement:
    numbers = np.array(changes)
    return Refinement(told, changed(told, numbers), numbers, SIGMAS, shift, {})


def test_the_calibration_stays_until_the_images_contradict_it() -> None:
    camera = CameraInUse(CalibrationConfig())
    assert camera.of(TOLD) == TOLD
    assert camera.refined is None
    assert camera.description() == ""
    assert not camera.is_better(found([0.0001, 0.0, 0.0], 5.0), final=True)  # less than its error
    assert not camera.is_better(found([0.008, 0.0, 0.0], 0.1), final=True)  # too little to matter
    assert not camera.is_better(found([0.008, 0.0, 0.0], 0.5), final=False)  # the end will do
    assert camera.is_better(found([0.008, 0.0, 0.0], 0.5), final=True)


def test_images_that_come_later_get_the_refined_camera_and_are_refined_from_the_calibration() -> None:
    camera = CameraInUse(CalibrationConfig())
    first = found([0.008, -0.01, 0.0], 4.0)
    camera.accept(first)
    assert camera.of(TOLD) == first.camera == camera.refined
    assert camera.told(first.camera) == TOLD
    other = replace(TOLD, cx=400.0)
    assert camera.of(other) == other == camera.told(other)
    second = found([0.0001, 0.0, 0.0], 0.1, first.camera)
    assert camera.is_better(second, final=True)  # once it is known to differ, the last estimate counts
    camera.accept(second)
    assert camera.told(second.camera) == TOLD
    text = camera.description()
    assert "focal length differs by +0.81 % (sigma 0.03 %)" in text
    assert "k1 by -0.0100 (sigma 0.0002)" in text
    assert "k2" not in text


def test_it_is_looked_at_ever_more_rarely() -> None:
    camera = CameraInUse(CalibrationConfig())
    assert [count for count in range(50) if camera.is_due(count)] == [FIRST_CHECK * factor for factor in (1, 2, 4, 8)]
    assert not any(CameraInUse(CalibrationConfig(focal_sigma=0.0)).is_due(count) for count in range(50))


@pytest.mark.parametrize(("before", "after", "agrees"), [(None, None, True), (0.1, None, False), (0.1, 0.2, False)])
def test_a_board_that_disagrees_keeps_the_calibration(before: float | None, after: float | None, agrees: bool) -> None:
    assert board_agrees(before, after) == agrees


def test_residuals_that_grow_with_the_radius_are_said() -> None:
    assert radial_warning(np.full(RADII, 0.03)) == ""
    assert radial_warning(np.full(RADII, np.nan)) == ""
    text = radial_warning(np.linspace(0, -0.4, RADII).astype(float))
    assert "to 0.40 px" in text
    assert "calibrate" in text
