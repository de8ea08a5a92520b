# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of lengths and of metres installed."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.product.product import Product, product_of
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd

SCALE_SIGMA, END_SIGMA = 1e-3, 2e-3
BOQ = BillOfQuantities((PipeClass("DN65", 0.0365, 9.0, (1.0, 0.0, 0.0), 4e-4),))


def pipe(length: float, sigma: float = END_SIGMA, place: int = 0) -> Pipe:
    cylinder = Cylinder(np.array([0.0, place, 0.0]), np.array([length, place, 0.0]), 0.0365)
    ends = (PipeEnd(sigma, "free"), PipeEnd(sigma, "wall"))
    return Pipe(f"p{place}", cylinder, 1e-4, "DN65", 1.0, 3.0, 1e-3, 100, "DN65", ends)


def product(pipes: list[Pipe]) -> Product:
    return product_of(pipes, BOQ, SCALE_SIGMA)


def test_the_spread_of_drawn_lengths_and_totals_is_what_is_stated() -> None:
    """Ends are drawn one by one, one scale for all pipes of a draw; 20 000 draws tell a sigma to 0.5 %."""
    rng = np.random.default_rng(3)
    lengths, draws = np.array([0.5, 1.5, 4.0]), 20_000
    scales = 1.0 + SCALE_SIGMA * rng.standard_normal((draws, 1))
    ends = END_SIGMA * rng.standard_normal((2, draws, len(lengths)))
    measured = scales * lengths + ends[0] + ends[1]
    told = product([pipe(length, place=place) for place, length in enumerate(lengths.tolist())])
    allowed = 4.0 / np.sqrt(2.0 * draws)
    for each, spread in zip(told.pipes, measured.std(axis=0), strict=True):
        assert told.length_sigma(each) == pytest.approx(spread, rel=allowed)
    assert told.installed_sigma("DN65") == pytest.approx(measured.sum(axis=1).std(), rel=allowed)


def states(*cylinders: Cylinder) -> list[tuple[str, str]]:
    """What is at the start and the end of each pipe."""
    ends = (PipeEnd(END_SIGMA, "free"), PipeEnd(END_SIGMA, "free"))
    pipes = [
        Pipe(f"p{number}", cylinder, 1e-4, "DN65", 1.0, 3.0, 1e-3, 100, "DN65", ends)
        for number, cylinder in enumerate(cylinders)
    ]
    return [(each.ends[0].state, each.ends[1].state) for each in product(pipes).pipes]


def along_x(low: float, high: float, radius: float = 0.0365) -> Cylinder:
    return Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.0]), radius)


def test_a_fitting_begins_where_a_joint_is() -> None:
    free, from_elbow = ("free", "free"), ("fitting", "free")
    upright = Cylinder(np.array([1.08, 0.0, 0.08]), np.array([1.08, 0.0, 1.0]), 0.0365)
    assert states(along_x(0.0, 1.0), upright) == [("free", "fitting"), from_elbow]
    branch = Cylinder(np.array([0.5, 0.0, 0.04]), np.array([0.5, 0.0, 1.0]), 0.0365)
    assert states(along_x(0.0, 1.0), branch) == [free, from_elbow]  # the run of a tee goes on
    assert states(along_x(0.0, 1.0), along_x(1.1, 2.0)) == [("free", "fitting"), from_elbow]  # a coupling
    assert states(along_x(0.0, 1.0, 0.0575), along_x(1.1, 2.0)) == [("free", "fitting"), from_elbow]  # a reducer
    assert states(along_x(0.0, 1.0), along_x(2.0, 3.0)) == [free, free]


def test_an_end_at_an_elbow_is_known_as_well_as_a_bend_shows() -> None:
    """A bend of three radii is 4 mm off the line of its pipe at 30 mm, for a radius of 36.5 mm."""
    upright = Cylinder(np.array([1.08, 0.0, 0.08]), np.array([1.08, 0.0, 1.0]), 0.0365)
    ends = (PipeEnd(END_SIGMA, "free"), PipeEnd(END_SIGMA, "free"))
    pipes = [
        Pipe(name, each, 1e-4, "DN65", 1.0, 3.0, 1e-3, 9, "DN65", ends)
        for name, each in (("a", along_x(0.0, 1.0)), ("b", upright))
    ]
    lying = product(pipes).pipes[0]
    shown = 3.0 * 0.0365 - np.sqrt((3.0 * 0.0365) ** 2 - 2.0 * 3.0 * 0.0365 * 4e-3)
    assert shown == pytest.approx(4e-3, rel=0.05)
    assert lying.ends[0].sigma == END_SIGMA
    assert 3.0 * lying.ends[1].sigma > np.sqrt(6.0 * 0.0365 * 4e-3) > lying.ends[1].sigma


def test_nothing_installed_is_certain_and_what_is_not_known_is_not_told() -> None:
    assert product([pipe(1.0)]).installed_sigma("DN100") == 0.0
    assert np.isnan(product([pipe(1.0), pipe(1.0, np.nan, 1)]).installed_sigma("DN65"))
    assert np.isnan(product_of([pipe(1.0)], BOQ).length_sigma(pipe(1.0)))
