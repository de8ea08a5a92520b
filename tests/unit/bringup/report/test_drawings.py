# SPDX-License-Identifier: Apache-2.0
"""Labels of plan and elevations."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from pipeprog_bringup.report.drawings import place_labels


def test_labels_do_not_lie_on_each_other_and_stay_inside() -> None:
    rng = np.random.default_rng(0)
    ends = rng.uniform([60, 60], [660, 340], (58, 2))
    shapes = [(f"p{k:02d} A", np.stack([end, end + rng.uniform(-40, 40, 2)]), 6.0) for k, end in enumerate(ends)]
    labels = place_labels(shapes, (720.0, 400.0))
    assert len(labels) == 58
    for label in labels:
        assert (label.low >= 0).all()
        assert (label.high <= [720, 400]).all()
    for one, other in combinations(labels, 2):
        assert ((one.low >= other.high) | (one.high <= other.low)).any(), (one.text, other.text)


def test_thirty_pipes_behind_each_other_all_get_a_label() -> None:
    """As a wall of pipes has in the plan."""
    end = np.array([[100.0, 200.0], [600.0, 200.0]])
    labels = place_labels([(f"p{k:02d} B", end + np.array([0.0, 0.1 * k]), 5.0) for k in range(30)], (720.0, 400.0))
    assert len({label.text for label in labels}) == 30
