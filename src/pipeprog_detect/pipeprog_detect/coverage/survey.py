# SPDX-License-Identifier: Apache-2.0
"""The coverage of a survey: of its pipes, of the planned ones whose places are known, and of the walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.coverage.axes import AxisCoverage, axis_coverage
from pipeprog_detect.coverage.planned import PlannedCoverage, planned_coverage
from pipeprog_detect.coverage.walls import WallCoverage, wall_coverage
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import FoundPipe, installed_where_planned
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.types import Pipe, View

_NO_IMAGE = np.zeros((0, 0), np.uint8)


@dataclass(frozen=True)
class SurveyCoverage:
    """What a survey's keyframes had in view.

    Attributes:
        pipes: axis of each measured pipe.
        planned: each planned pipe; empty where the plan has no places.
        walls: for the radius of each class.
    """

    pipes: list[AxisCoverage]
    planned: list[PlannedCoverage]
    walls: WallCoverage


def survey_coverage(
    pipes: Sequence[Pipe], planned: Sequence[PlannedPipe], radii: Sequence[float], points: FloatArray, views: list[View]
) -> SurveyCoverage:
    """The coverage of pipes, planned pipes and walls; `radii` [m] are those of the classes, `views` have depths."""
    found = [FoundPipe(pipe.id, pipe.cylinder, pipe.class_name or "") for pipe in pipes]
    return SurveyCoverage(
        axis_coverage([pipe.cylinder for pipe in pipes], views),
        planned_coverage(installed_where_planned(planned, found), views),
        wall_coverage(points, radii, views),
    )


def views_of(cameras: Sequence[Camera], map_from_camera: FloatArray, points: FloatArray) -> list[View]:
    """Views without images of cameras at poses (M, 4, 4), with the depths that the cloud's points (N, 3) give them."""
    views = [
        View(number, _NO_IMAGE, camera.pinhole(), np.linalg.inv(pose).astype(float))
        for number, (camera, pose) in enumerate(zip(cameras, map_from_camera, strict=True))
    ]
    return with_depths(views, points)
