# SPDX-License-Identifier: Apache-2.0
"""Pipes of a NumPy cloud: the detector's core with arrays in place of files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from pipeprog_detect import detector
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.types import Cloud, Pipe, View


def detect(
    points: ArrayLike | Cloud,
    radii: Sequence[float] | Mapping[str, float] | BillOfQuantities,
    views: Sequence[View] = (),
    *,
    config: DetectConfig | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> list[Pipe]:
    """Finds, measures and classifies the pipes of a metric cloud.

    Args:
        points: (N, 3) coordinates [m] in any frame, in which the pipes come back; or a `Cloud`, which may hold
            normals towards the sensor, too: they tell a pipe's outside from its inside.
        radii: planned outer radii [m]: a sequence (the classes are then named by it, such as "57.5 mm"), a mapping
            from class names, or a bill of quantities as `load_boq` reads it.
        views: keyframes of the same frame; where they are given, pipes are measured in them.
        config: settings of the detector; the defaults of docs/parameters.md without.
        progress: called with the share done (0 to 1) and what is being done.

    Returns:
        The pipes, sorted by place: `pipe.cylinder` holds start (3,), end (3,) and radius [m], `pipe.class_name` is
        None where no planned class fits.

    Raises:
        InputError: no point is finite, the shapes do not fit, or a radius is no length.
    """
    cloud = points if isinstance(points, Cloud) else Cloud(np.asarray(points, np.float64))
    boq = radii if isinstance(radii, BillOfQuantities) else BillOfQuantities.of_radii(_named(radii))
    return detector.detect(cloud, boq, config or DetectConfig(), views, progress)


def _named(radii: Sequence[float] | Mapping[str, float]) -> dict[str, float]:
    """Radii [m] by class name."""
    if isinstance(radii, Mapping):
        return {str(name): float(radius) for name, radius in radii.items()}
    return {f"{1e3 * float(radius):g} mm": float(radius) for radius in radii}
