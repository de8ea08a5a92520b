# SPDX-License-Identifier: Apache-2.0
"""What a viewer shows of the pipes: a cylinder in the colour of its class and a label for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.types import Pipe

UNKNOWN_COLOR = (0.6, 0.6, 0.6)  # grey: no planned class
LABEL_HEIGHT = 0.06  # [m] readable beside the thinnest pipe
LABEL_GAP = 0.03  # [m] above the barrel


@dataclass(frozen=True)
class PipeMarker:
    """A cylinder along its local z, orientation (x, y, z, w), with a label above it; metres, frame `map`."""

    centre: FloatArray
    orientation: FloatArray
    radius: float
    length: float
    color: tuple[float, float, float]
    text: str
    text_position: FloatArray


def pipe_markers(pipes: Sequence[Pipe], boq: BillOfQuantities) -> list[PipeMarker]:
    """One marker for each pipe, in the same order."""
    colors = {planned.name: planned.color for planned in boq.classes}
    markers = []
    for pipe in pipes:
        cylinder = pipe.cylinder
        centre = cylinder.middle
        above = 0.5 * cylinder.length * abs(cylinder.axis[2]) + cylinder.radius + LABEL_GAP
        name = pipe.class_name or "unknown"
        markers.append(
            PipeMarker(
                centre,
                _turn_of_z(cylinder.axis),
                cylinder.radius,
                cylinder.length,
                colors.get(name, UNKNOWN_COLOR),
                f"{name}  r {1e3 * cylinder.radius:.1f} mm  {cylinder.length:.2f} m",
                centre + np.array([0.0, 0.0, above]),
            )
        )
    return markers


def _turn_of_z(direction: FloatArray) -> FloatArray:
    """The quaternion (x, y, z, w) of the shortest rotation that takes z to the unit vector `direction`."""
    if direction[2] < -1.0 + 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.array([-direction[1], direction[0], 0.0, 1.0 + direction[2]])
    return quaternion / np.linalg.norm(quaternion)
