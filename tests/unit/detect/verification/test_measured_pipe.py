# SPDX-License-Identifier: Apache-2.0
"""Pieces of one pipe are one."""

from __future__ import annotations

import numpy as np

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, joined
from tests.unit.detect.silhouette.test_free_space import HALF, seen, tube


def test_a_pipe_found_by_its_lines_and_in_the_cloud_is_one() -> None:
    """As thick as the better measured one; another pipe on its line, too far on, stays one of its own."""

    def piece(low: float, high: float, radius_sigma: float, points: int) -> MeasuredPipe:
        cylinder = Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.002]), 0.0086 + radius_sigma)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        candidate = Candidate(cylinder, radius_sigma, points, evidence)
        return MeasuredPipe(candidate, cylinder, radius_sigma)

    far, short, long = piece(8.0, 9.0, 1e-4, 300), piece(0.0, 0.8, 3e-4, 500), piece(1.0, 3.0, 2e-4, 100)
    found = joined([far, short, long], [])
    assert len(found) == 2
    assert found[0].cylinder is far.cylinder
    assert found[1].cylinder.length > 2.99
    assert found[1].cylinder.radius == long.cylinder.radius
    assert found[1].radius_sigma == long.radius_sigma
    assert found[1].candidate.points == 600
    assert joined([], []) == []


def test_pieces_are_one_pipe_where_nothing_is_seen_between_them() -> None:
    def piece(low: float, high: float, radius: float) -> MeasuredPipe:
        cylinder = Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.0]), radius)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        return MeasuredPipe(Candidate(cylinder, 2e-4, 100, evidence), cylinder, 2e-4)

    left, right, thicker = piece(-HALF, -0.1, 0.03), piece(0.1, HALF, 0.03), piece(0.1, HALF, 0.032)
    gap = seen(tube(-HALF, -0.1, 0.03), tube(0.1, HALF, 0.03))
    whole = seen(tube(-HALF, HALF, 0.03))
    assert len(joined([left, right], whole)) == 1
    assert len(joined([left, right], gap)) == 2
    assert len(joined([left, thicker], whole)) == 2
