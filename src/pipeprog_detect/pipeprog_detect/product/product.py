# SPDX-License-Identifier: Apache-2.0
"""The product of a survey: what a robot is told on `pipes`, and what the files of the results hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import ClassProgress, progress
from pipeprog_detect.product.pipe_runs import PipeRun, pipe_runs
from pipeprog_detect.types import Pipe


@dataclass(frozen=True)
class Product:
    """The pipes of a map, the progress of each planned class, and which pipes fittings connect."""

    pipes: list[Pipe]
    classes: list[ClassProgress]
    runs: list[PipeRun]


def product_of(pipes: Sequence[Pipe], boq: BillOfQuantities) -> Product:
    """The product that these pipes make; their ids are final."""
    return Product(list(pipes), progress(pipes, boq), pipe_runs(pipes))
