# SPDX-License-Identifier: Apache-2.0
"""What a fit says of itself."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.types import Cylinder


@pytest.mark.parametrize(
    ("flatness", "sigma", "is_round", "is_flat"),
    [(-0.04, 0.03, True, False), (1.0, 0.2, False, True), (0.0, 0.5, False, False), (1.0, 0.5, False, False)],
)
def test_flatness_tells_where_views_differ_enough(flatness: float, sigma: float, is_round: bool, is_flat: bool) -> None:
    pipe = Cylinder(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0086)
    fit = ContourFit(pipe, np.eye(3)[1:], np.eye(5), 1e-4, 1.0, 100.0, 20, (0.0, 0.0), flatness, sigma)
    assert (fit.is_round, fit.is_flat) == (is_round, is_flat)
