# SPDX-License-Identifier: Apache-2.0
"""Which cylinders are pieces of one pipe, which are elbows."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.cloud.collinear import elbows, join, spanning
from pipeprog_detect.types import Cylinder


def along_x(low: float, high: float, y: float = 0.0, radius: float = 0.03, rise: float = 0.0) -> Cylinder:
    return Cylinder(np.array([low, y, 0.0]), np.array([high, y + rise, 0.0]), radius)


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (along_x(1.2, 2.0), True),
        (along_x(2.0, 1.2), True),
        (along_x(1.2, 2.0, y=0.005), True),
        (along_x(1.2, 2.0, y=0.02), False),
        (along_x(1.2, 2.0, radius=0.036), False),
        (along_x(1.2, 2.0, rise=0.1), False),
        (along_x(2.5, 3.0), False),
    ],
)
def test_pieces_of_one_pipe(other: Cylinder, same: bool) -> None:
    groups = join([along_x(0.0, 1.0), along_x(0.0, 1.0, y=5.0), other])
    assert groups == ([[0, 2], [1]] if same else [[0], [1], [2]])


def test_three_pieces_span_from_end_to_end() -> None:
    pieces = [along_x(1.2, 2.0), along_x(0.0, 1.0, radius=0.031), along_x(2.3, 2.5)]
    assert join(pieces) == [[0, 1, 2]]
    whole = spanning(pieces, best=1)
    assert whole.length == pytest.approx(2.5)
    assert whole.radius == 0.031


def test_a_short_cylinder_across_a_corner_is_an_elbow() -> None:
    corner = Cylinder(np.array([1.02, 0.0, 0.0]), np.array([1.1, 0.08, 0.0]), 0.03)
    assert elbows([along_x(0.0, 1.0), corner]) == {1}
    assert elbows([along_x(0.0, 1.0), along_x(1.05, 1.15)]) == set()
