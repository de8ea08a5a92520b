# SPDX-License-Identifier: Apache-2.0
"""The product of a survey: what a robot is told on `pipes`, and what the files of the results hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import ClassProgress, progress
from pipeprog_detect.product.pipe_runs import PipeRun, pipe_runs, with_fittings
from pipeprog_detect.types import Pipe


@dataclass(frozen=True)
class Product:
    """The pipes of a map, the progress of each planned class, and which pipes fittings connect.

    `scale_sigma`: relative standard deviation of the map's scale; NaN where it is not known.
    """

    pipes: list[Pipe]
    classes: list[ClassProgress]
    runs: list[PipeRun]
    scale_sigma: float = float("nan")

    def length_sigma(self, pipe: Pipe) -> float:
        """Standard deviation of a pipe's length [m]."""
        return _length_sigma([pipe], self.scale_sigma)

    def installed_sigma(self, class_name: str) -> float:
        """Standard deviation of the metres installed of a class [m]."""
        return _length_sigma([pipe for pipe in self.pipes if pipe.class_name == class_name], self.scale_sigma)


def product_of(pipes: Sequence[Pipe], boq: BillOfQuantities, scale_sigma: float = float("nan")) -> Product:
    """The product that these pipes make; their ids are final."""
    runs = pipe_runs(pipes)
    fitted = with_fittings(pipes, runs)
    return Product(fitted, progress(fitted, boq), runs, scale_sigma)


def _length_sigma(pipes: Sequence[Pipe], scale_sigma: float) -> float:
    """Standard deviation of the sum of the lengths [m]: ends err each for itself, the scale in all lengths alike."""
    ends = float(np.sqrt(sum(end.sigma**2 for pipe in pipes for end in pipe.ends)))
    return float(np.hypot(ends, scale_sigma * sum(pipe.cylinder.length for pipe in pipes))) if pipes else 0.0
