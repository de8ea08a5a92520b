# SPDX-License-Identifier: Apache-2.0
"""When a survey goes on with a refined camera, and what it says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.camera_in_use import FIRST_CHECK, UNKNOWN_READOUT, CameraInUse, board_agrees, radial_warning
from pipeprog_sfm.config import CalibrationConfig
from pipeprog_sfm.model.self_calibration import RADII, Refinement, changed

TOLD = Camera(848, 480, 600.0, 600.0, 423.5, 239.5)
SIGMAS = np.array([0.0003, 0.0002, np.inf, np.inf])


def found(changes: list[float], shift: float, told: Camera = TOLD) -> Refinement:
    numbers = np.array([*changes, 0.0])
    return Refinement(told, changed(told, numbers), 0.0, 0.0, numbers, SIGMAS, shift, {})


def readout_found(readout: float, change: float, sigma: float, shift: float = 5.0) -> Refinement:
    sigmas = np.array([np.inf, np.inf, np.inf, sigma if change else np.inf])
    return Refinement(TOLD, TOLD, readout, sigma, np.array([0.0, 0.0, 0.0, change]), sigmas, shift, {})


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
    assert camera.priors(first.camera).camera == TOLD
    other = replace(TOLD, cx=400.0)
    assert camera.of(other) == other == camera.priors(other).camera
    second = found([0.0001, 0.0, 0.0], 0.1, first.camera)
    assert camera.is_better(second, final=True)  # once it is known to differ, the last estimate counts
    camera.accept(second)
    assert camera.priors(second.camera).camera == TOLD
    text = camera.description()
    assert "focal length differs by +0.81 % (sigma 0.03 %)" in text
    assert "k1 by -0.0100 (sigma 0.0002)" in text
    assert "k2" not in text


def test_it_is_looked_at_ever_more_rarely() -> None:
    camera = CameraInUse(CalibrationConfig())
    assert [count for count in range(50) if camera.is_due(count)] == [FIRST_CHECK * factor for factor in (1, 2, 4, 8)]
    assert not any(CameraInUse(CalibrationConfig(focal_sigma=0.0), 0.0).is_due(count) for count in range(50))


def test_a_read_out_that_is_not_told_is_found_and_said() -> None:
    camera = CameraInUse(CalibrationConfig(focal_sigma=0.0), None)
    assert np.isnan(camera.readout_sigma)
    assert camera.priors(TOLD).sigmas.tolist() == [0, 0, 0, UNKNOWN_READOUT]
    first = readout_found(0.0148, 0.0148, 0.00002)
    assert camera.is_better(first, final=False)
    camera.accept(first)
    assert camera.refined is None  # the calibration stays
    assert camera.readout_sigma == pytest.approx(0.0003, rel=0.02)
    assert camera.description().endswith("the read-out is 14.80 ms (sigma 0.30 ms; not told)")
    assert camera.readout_warning() == ""
    later = readout_found(0.0150, 0.0002, 0.0001, shift=0.3)  # a part of it, which all keyframes to come are read with
    assert camera.is_better(later, final=False)
    little = replace(later, shift=0.1)
    assert not camera.is_better(little, final=False)  # the end will do
    assert camera.is_better(little, final=True)
    assert not camera.is_better(readout_found(0.0148, 0.0, 0.0001, shift=0.3), final=True)


def test_a_read_out_that_is_told_is_a_prior_and_zero_is_a_fact() -> None:
    told = CameraInUse(CalibrationConfig(), 0.012)
    assert told.priors(TOLD).readout == 0.012
    assert told.priors(TOLD).sigmas[3] == pytest.approx(0.0036)
    assert told.readout_sigma == 0.0
    told.accept(readout_found(0.015, 0.003, 0.00002))
    assert "the read-out is 15.00 ms (sigma 0.30 ms; told 12 ms)" in told.description()
    assert told.priors(TOLD, waiting=True).sigmas[:3].tolist() == [0, 0, 0]  # first the read-out
    assert (CameraInUse(CalibrationConfig(focal_sigma=0.05), 0.012).priors(TOLD, waiting=True).sigmas > 0).all()
    for given in (CameraInUse(CalibrationConfig(), 0.0), CameraInUse(CalibrationConfig(readout_sigma=0.0), 0.012)):
        assert given.priors(TOLD).sigmas[3] == 0.0


def test_images_that_do_not_tell_the_read_out_are_said() -> None:
    camera = CameraInUse(CalibrationConfig(), None)
    for sigma, said in ((0.00001, False), (0.02, True)):
        assert not camera.is_better(readout_found(0.0, 0.0, sigma), final=True)
        assert ("turn the phone" in camera.readout_warning()) == said
        assert camera.readout_sigma == sigma


@pytest.mark.parametrize(("before", "after", "agrees"), [(None, None, True), (0.1, None, False), (0.1, 0.2, False)])
def test_a_board_that_disagrees_keeps_the_calibration(before: float | None, after: float | None, agrees: bool) -> None:
    assert board_agrees(before, after) == agrees


def test_residuals_that_grow_with_the_radius_are_said() -> None:
    assert radial_warning(np.full(RADII, 0.03)) == ""
    assert radial_warning(np.full(RADII, np.nan)) == ""
    text = radial_warning(np.linspace(0, -0.4, RADII).astype(float))
    assert "to 0.40 px" in text
    assert "calibrate" in text
