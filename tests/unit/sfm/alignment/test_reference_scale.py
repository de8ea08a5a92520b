# SPDX-License-Identifier: Apache-2.0
"""The metres of an aligned survey are those of its reference; its own scale checks them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_sfm.alignment.alignment import Alignment
from pipeprog_sfm.alignment.plane_check import PlaneCheck
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.metric.scale import DISAGREEMENT, ScaleEstimate
from pipeprog_sfm.reconstruction import in_frame_of

SCALE = 2.0  # metres of the reference per unit of the model
REFERENCE_SIGMA, ALIGNMENT_SIGMA, OWN_SIGMA = 3e-4, 4e-4, 12e-4
SIGMA = 5e-4  # of reference and alignment together
SPREAD = 13e-4  # of the difference of the two scales
REFERENCE = SurveyMap(
    frame="monday",
    aligned_by="",
    scale_sigma=REFERENCE_SIGMA,
    stamps=np.zeros(0, np.int64),
    cameras=(),
    map_from_camera=np.zeros((0, 4, 4)),
    offsets=np.zeros(1, np.int64),
    pixels=np.zeros((0, 2), np.float32),
    descriptors=np.zeros((0, 128), np.uint8),
    point_of=np.zeros(0, np.int64),
    points=np.zeros((0, 3)),
)
ALIGNMENT = Alignment(
    by="places",
    reference_from_model=np.diag([SCALE, SCALE, SCALE, 1.0]),
    covariance=np.diag([0.0] * 6 + [ALIGNMENT_SIGMA**2]),
    shared=1000,
    planes=PlaneCheck(0, 0.0, 0.0),
)


def own(gap: float) -> ScaleEstimate:
    """A scale by a board that is this many standard deviations of the difference from that of the reference."""
    scale = SCALE * np.exp(gap * SPREAD)
    return ScaleEstimate(scale, OWN_SIGMA, "board", (), np.eye(4), "of the board", (), (), ("told before",))


@pytest.mark.parametrize("gap", [-DISAGREEMENT - 0.1, DISAGREEMENT + 0.1])
def test_scales_that_differ_by_more_than_three_sigma_are_told(gap: float) -> None:
    found = in_frame_of(REFERENCE, ALIGNMENT, own(gap))
    assert found.warnings[0] == "told before"
    (warning,) = found.warnings[1:]
    off = f"{100 * np.expm1(gap * SPREAD):+.2f} %"
    assert f"own scale (board) is {off} off that of the reference" in warning
    assert "three times their uncertainty (0.13 %)" in warning
    assert found.scale == pytest.approx(SCALE)  # the reference's all the same


@pytest.mark.parametrize("gap", [-DISAGREEMENT + 0.1, 0.0, DISAGREEMENT - 0.1])
def test_scales_within_three_sigma_are_no_warning(gap: float) -> None:
    found = in_frame_of(REFERENCE, ALIGNMENT, own(gap))
    assert found.warnings == ("told before",)
    assert (found.scale, found.sigma) == (pytest.approx(SCALE), pytest.approx(SIGMA))
    assert found.source == "reference+board"
    assert found.map_from_model is ALIGNMENT.reference_from_model


def test_a_survey_without_a_scale_of_its_own_has_that_of_the_reference() -> None:
    found = in_frame_of(REFERENCE, ALIGNMENT, None)
    assert (found.scale, found.sigma) == (pytest.approx(SCALE), pytest.approx(SIGMA))
    assert (found.source, found.warnings) == ("reference", ())
