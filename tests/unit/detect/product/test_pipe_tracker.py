# SPDX-License-Identifier: Apache-2.0
"""Pipes keep their names while the map moves, grows and loses sight of some."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_detect.product.pipe_tracker import PipeTracker
from pipeprog_detect.types import Cylinder, Pipe

STEP = 0.095  # between the axes of a rack, 1.3 diameters of the thinner pipes


def pipe(x: float, low: float = 0.0, high: float = 1.0, radius: float = 0.0365) -> Pipe:
    cylinder = Cylinder(np.array([x, 0.0, low]), np.array([x, 0.0, high]), radius)
    return Pipe("", cylinder, 1e-4, None, 0.0, 3.0, 1e-3, 100)


def ids(pipes: list[Pipe]) -> list[str]:
    return [one.id for one in pipes]


def test_the_first_map_numbers_pipes_in_their_order() -> None:
    assert ids(PipeTracker().named([pipe(0.0), pipe(1.0)])) == ["p01", "p02"]
    assert PipeTracker().named([]) == []


@given(st.permutations(range(4)), st.floats(-8e-3, 8e-3), st.floats(-0.2, 0.3))
def test_names_stay_when_pipes_of_a_rack_move_grow_and_change_places(
    order: list[int], shift: float, growth: float
) -> None:
    identities = PipeTracker()
    first = identities.named([pipe(STEP * number) for number in range(4)])
    again = identities.named([pipe(STEP * number + shift, high=1.0 + growth) for number in order])
    assert ids(again) == [first[number].id for number in order]


def test_a_name_is_remembered_and_never_given_to_another() -> None:
    identities = PipeTracker()
    identities.named([pipe(0.0), pipe(1.0)])
    assert ids(identities.named([pipe(1.0), pipe(2.0)])) == ["p02", "p03"]
    assert ids(identities.named([pipe(0.0)])) == ["p01"]


def test_a_pipe_that_crosses_or_follows_is_another() -> None:
    identities = PipeTracker()
    identities.named([pipe(0.0)])
    crossing = Cylinder(np.array([-0.5, 0.0, 0.5]), np.array([0.5, 0.0, 0.5]), 0.0365)
    other = Pipe("", crossing, 1e-4, None, 0.0, 3.0, 1e-3, 100)
    assert ids(identities.named([other, pipe(0.0, 1.2, 2.0)])) == ["p02", "p03"]
