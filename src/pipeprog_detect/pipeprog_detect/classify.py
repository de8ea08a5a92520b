"""Which planned class a measured radius belongs to, or none; and how much of each class is installed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_detect.bill import Bill
from pipeprog_detect.pipe import Pipe

# A pipe farther than this from every nominal radius, in standard deviations of measurement and make, is none of them.
_REJECT = 4.0
# Under this probability the class is ambiguous.
SURE = 0.95


@dataclass(frozen=True)
class ClassProgress:
    """Progress of one class: metres planned and installed, percent of the plan."""

    name: str
    outer_radius: float
    planned: float
    installed: float
    percent: float


def classify(radius: float, sigma: float, bill: Bill) -> tuple[str | None, float]:
    """Most probable class of a pipe of `radius` +- `sigma` [m] and its posterior probability.

    Nominal radii stay fixed; the likelihood is Gaussian with the measurement's and the manufacturer's variance, the
    prior is even. A radius more than four standard deviations from every class has none: (None, 0).
    """
    nominal = np.array([planned.outer_radius for planned in bill.classes])
    variance = sigma**2 + np.array([planned.tolerance for planned in bill.classes]) ** 2
    distance = (radius - nominal) ** 2 / variance
    likely = -0.5 * distance - 0.5 * np.log(variance)
    posterior = np.exp(likely - likely.max())
    posterior /= posterior.sum()
    best = int(np.argmax(posterior))
    if distance[best] > _REJECT**2:
        return None, 0.0
    return bill.classes[best].name, float(posterior[best])


def progress(pipes: Sequence[Pipe], bill: Bill) -> list[ClassProgress]:
    """Metres installed of each planned class, in the bill's order."""
    table = []
    for planned in bill.classes:
        installed = float(sum(pipe.cylinder.length for pipe in pipes if pipe.class_name == planned.name))
        percent = 100.0 * installed / planned.planned_length
        table.append(ClassProgress(planned.name, planned.outer_radius, planned.planned_length, installed, percent))
    return table
