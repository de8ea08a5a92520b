# SPDX-License-Identifier: Apache-2.0
"""Pipes along walls: where the contour leaves a pipe's slope open, the wall that it runs along tells it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.scene_context import SceneContext

# Clips and hangers of one length hold a pipe at one distance from its wall or ceiling, up to this far from it [m].
HELD_WITHIN = 0.5
# Standard deviation of its slope to the wall [rad]: two clips a metre apart, each set to 2 mm.
CLIP_SLOPE = 3e-3
# A slope that differs from the wall's by more standard deviations is another one: drains fall by 1 to 2 %.
OTHER_SLOPE = 3.0
# The wall is seen along this share of the pipe, in steps of this length [m].
ALONGSIDE, STEP = 0.5, 0.1


def parallel_to_wall(measured: MeasuredPipe, around: SceneContext) -> MeasuredPipe:
    """The pipe after one more observation: it is parallel to the nearest wall that it may be parallel to.

    Cameras that pass along a thin pipe at one height see its contour exactly and its distance badly: its ends are
    centimetres off while its image fits. With the covariance of the contour the observation moves only what the contour
    leaves open: the measurement update of a Kalman filter (R. E. Kalman, 1960).
    """
    fit = measured.fit
    if fit is None:
        return measured
    cylinder = measured.cylinder
    for plane in _walls_along(cylinder, around):
        gradient = np.zeros(5)
        gradient[2:4] = fit.across @ plane.normal
        slope = float(plane.normal @ cylinder.axis)
        gain = fit.covariance @ gradient
        variance = float(gradient @ gain) + CLIP_SLOPE**2
        if slope**2 < OTHER_SLOPE**2 * variance:
            step = -slope / variance * gain
            middle = cylinder.middle + step[0:2] @ fit.across
            half = 0.5 * cylinder.length * (cylinder.axis + step[2:4] @ fit.across)
            turned = Cylinder(middle - half, middle + half, float(cylinder.radius + step[4]))
            covariance = fit.covariance - np.outer(gain, gain) / variance
            sigma = float(np.sqrt(covariance[4, 4]))
            fit = replace(fit, cylinder=turned, covariance=covariance, radius_sigma=sigma)
            return replace(measured, cylinder=turned, radius_sigma=sigma, fit=fit)
    return measured


def _walls_along(cylinder: Cylinder, around: SceneContext) -> Sequence[Plane]:
    """Planes along most of the cylinder, the nearest first."""
    rows = around.walls.near_segment(cylinder.start, cylinder.end, HELD_WITHIN)
    points: FloatArray = around.walls.points[rows]
    steps = max(int(cylinder.length / STEP), 2)
    place = np.clip((cylinder.along(points) / cylinder.length * steps).astype(np.int64), 0, steps - 1)
    walls = []
    for plane in around.planes:
        on = np.abs(points @ plane.normal - plane.offset) < 3.0 * around.sigma
        if len(np.unique(place[on])) > ALONGSIDE * steps:
            walls.append(plane)
    return sorted(walls, key=lambda plane: abs(float(plane.normal @ cylinder.middle) - plane.offset))
