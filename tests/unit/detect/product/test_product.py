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


def pipe(length: float, sigma: float = END_SIGMA) -> Pipe:
    cylinder = Cylinder(np.zeros(3), np.array([length, 0.0, 0.0]), 0.0365)
    ends = (PipeEnd(sigma, "free"), PipeEnd(sigma, "wall"))
    return Pipe("p01", cylinder, 1e-4, "DN65", 1.0, 3.0, 1e-3, 100, "DN65", ends)


def product(pipes: list[Pipe]) -> Product:
    return product_of(pipes, BOQ, SCALE_SIGMA)


def test_the_spread_of_drawn_lengths_and_totals_is_what_is_stated() -> None:
    """Ends are drawn one by one, one scale for all pipes of a draw; 20 000 draws tell a sigma to 0.5 %."""
    rng = np.random.default_rng(3)
    lengths, draws = np.array([0.5, 1.5, 4.0]), 20_000
    scales = 1.0 + SCALE_SIGMA * rng.standard_normal((draws, 1))
    ends = END_SIGMA * rng.standard_normal((2, draws, len(lengths)))
    measured = scales * lengths + ends[0] + ends[1]
    told = product([pipe(length) for length in lengths])
    allowed = 4.0 / np.sqrt(2.0 * draws)
    for each, spread in zip(told.pipes, measured.std(axis=0), strict=True):
        assert told.length_sigma(each) == pytest.approx(spread, rel=allowed)
    assert told.installed_sigma("DN65") == pytest.approx(measured.sum(axis=1).std(), rel=allowed)


def test_nothing_installed_is_certain_and_what_is_not_known_is_not_told() -> None:
    assert product([pipe(1.0)]).installed_sigma("DN100") == 0.0
    assert np.isnan(product([pipe(1.0), pipe(1.0, np.nan)]).installed_sigma("DN65"))
    assert np.isnan(product_of([pipe(1.0)], BOQ).length_sigma(pipe(1.0)))
