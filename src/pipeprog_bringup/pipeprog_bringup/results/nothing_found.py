# SPDX-License-Identifier: Apache-2.0
"""Why a cloud gave no metre of the bill, and what can be done about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.product import Product

_SITE = 500.0  # m; no survey is wider, but a room of 2 m in millimetres is
_SCENE = 0.05  # m; the shortest pipe is longer, but a site of 50 m in kilometres is not
_SAMPLE = 2000  # points whose neighbours are looked at: their median is known to 3 %


def why_nothing_was_found(product: Product, points: NDArray[np.floating], boq: BillOfQuantities) -> list[str]:
    """A sentence with reason and remedy where no pipe (N, 3 points, in metres) has a planned class; none otherwise."""
    if any(pipe.class_name for pipe in product.pipes):
        return []
    planned = [1e3 * one.outer_radius for one in boq.classes]
    if product.pipes:
        found = [1e3 * pipe.cylinder.radius for pipe in product.pipes]
        undecided = sum(pipe.class_probability > 0.0 for pipe in product.pipes)
        if undecided:
            return [
                f"{len(found)} pipes were found, none surely of one class: {undecided} may be of either of two planned "
                f"ones, whose outer radii or materials are too near to be told apart; found: {_range(found)}, planned: "
                f"{_range(planned)}: make one class of the two, or film from nearer by"
            ]
        return [
            f"{len(found)} pipes were found, none of a planned class: their outer radii are {_range(found)}, those of "
            f"the bill {_range(planned)}: is it the bill of this site, and the scale the right one?"
        ]
    return [f"no pipes were found: {_of_points(points, min(planned))}"]


def _of_points(points: NDArray[np.floating], smallest: float) -> str:
    """The reason that the cloud shows; `smallest` is the least planned radius [mm]."""
    if len(points) < 2:
        return "the cloud has no points: film surfaces with texture, or run with another recording"
    width = float(np.ptp(np.quantile(points, (0.01, 0.99), axis=0), axis=0).max())
    if not _SCENE < width < _SITE:
        return (
            f"the cloud is {width:.{0 if width > 1 else 3}f} m wide: is it in another unit? Clouds are read in metres"
        )
    sample = points[:: max(1, len(points) // _SAMPLE)]
    spacing = 1e3 * float(np.median(cKDTree(points).query(sample, k=2)[0][:, 1]))
    if spacing > smallest:
        return (
            f"the points of the cloud are {spacing:.0f} mm apart, and the thinnest planned pipe has an outer radius of "
            f"{smallest:.1f} mm: film or scan from nearer by"
        )
    return (
        "no surface of the cloud is round along a straight line: were there pipes in view, from 1 to 4 m and from more "
        "than one side? docs/recording.md says how to film them"
    )


def _range(radii: list[float]) -> str:
    low, high = f"{min(radii):.1f}", f"{max(radii):.1f}"
    return f"{low} mm" if low == high else f"{low} to {high} mm"
