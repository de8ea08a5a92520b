# SPDX-License-Identifier: Apache-2.0
"""What is seen between the outlines of two known pipes is no thin pipe."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.silhouette.apparent_contour import contour_samples
from pipeprog_detect.thin.line_segments import SegmentPairs
from pipeprog_detect.thin.pair_views import ON_OUTLINE, between_outlines
from pipeprog_detect.types import Cylinder
from tests.unit.detect.straight_ahead import looking_along_y

UPPER = Cylinder(np.array([-0.3, 0.0, 0.06]), np.array([0.3, 0.0, 0.06]), 0.05)
LOWER = Cylinder(np.array([-0.3, 0.1, -0.06]), np.array([0.3, 0.1, -0.06]), 0.05)


def outline(cylinder: Cylinder, lower: bool) -> np.ndarray:
    """Ends (2, 2) [px] of its upper or its lower outline in the view, in the middle half of it."""
    samples = contour_samples(cylinder, [VIEW], np.eye(3)[:2], 5.0, 0.0)
    heights = [samples.pixel[samples.side == side, 1].mean() for side in (0, 1)]
    line = samples.pixel[samples.side == int(np.argmax(heights) if lower else np.argmin(heights))]
    return np.stack([line[len(line) // 4], line[3 * len(line) // 4]])


VIEW = looking_along_y(0.0, 0)


@pytest.mark.parametrize(
    ("shift", "known", "between"),
    [(0.0, [UPPER, LOWER], True), (1.5 * ON_OUTLINE, [UPPER, LOWER], False), (0.0, [UPPER], False), (0.0, [], False)],
)
def test_both_sides_must_be_outlines_of_known_pipes(shift: float, known: list[Cylinder], between: bool) -> None:
    above, below = outline(UPPER, True), outline(LOWER, False) + np.array([0.0, shift])
    pair = SegmentPairs(0.5 * (above + below)[None], (below - above)[None, :, 1])
    assert between_outlines(pair, known, VIEW).tolist() == [between]


def test_no_segment_pairs_are_no_matter() -> None:
    assert len(between_outlines(SegmentPairs(np.zeros((0, 2, 2)), np.zeros((0, 2))), [UPPER], VIEW)) == 0
