# SPDX-License-Identifier: Apache-2.0
"""Planned radii of blurred candidates: a fit that a shadow's line has led away from its radius is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.silhouette.contour_fit import ContourFit
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification import candidate_fit
from pipeprog_detect.verification.candidate_fit import CandidateFitter
from pipeprog_detect.verification.measurement_cache import MeasurementCache

PLANNED, SIGMA = 0.0086, 0.00015
PIPE = Cylinder(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0105)
BLURRED = Candidate(PIPE, 0.002, 300, CloudEvidence(np.pi, 0.8, 0.0, 0.004, 0.0, 3.0))


@pytest.mark.parametrize(("sigmas", "stands"), [(0.0, True), (2.9, True), (4.5, False)])
def test_a_fit_keeps_to_the_planned_radius_that_it_was_sought_with(
    monkeypatch: pytest.MonkeyPatch, sigmas: float, stands: bool
) -> None:
    found = replace(PIPE, radius=PLANNED + sigmas * SIGMA)
    fit = ContourFit(found, np.eye(5), SIGMA, 0.7, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(candidate_fit, "_at_radius", lambda *_: fit)
    boq = BillOfQuantities((PipeClass("copper 17", PLANNED, 10.0, (1.0, 0.0, 1.0), 1e-4),))
    assert BLURRED.blurred
    assert (CandidateFitter(boq, MeasurementCache()).of_planned_radius(BLURRED, [], []) is fit) is stands
