# SPDX-License-Identifier: Apache-2.0
"""Lines that look like thin pipes and are none: edges of faces, and steps of the light between two surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.silhouette.axial_evidence import STEP_AT
from pipeprog_detect.silhouette.scene import SPACING, Scene
from pipeprog_detect.thin.depth_from_cloud import is_edge_of_face
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.candidate_fit import CONVINCING

# A step between two surfaces is one edge: beside it texture alone changes the light, on average by less than this share
# of the step. A pipe differs from what is behind it on both sides; two surfaces of which one is as bright as the pipe
# would have to agree with it to this share.
ONE_STEP = 1.0 / 8.0
# Towards the edge between two faces light falls off over some millimetres (ambient occlusion), which adds to the change
# beside the step if it goes on in the direction of the step: twice the share then. A pipe mostly differs from what lies
# on both sides in the same direction.
ONE_STAIR = 2.0 * ONE_STEP


def is_false_line(
    cylinder: Cylinder,
    points: NDArray[np.float32],
    walls: Sequence[Plane],
    views: Sequence[View],
    others: Sequence[Cylinder],
) -> bool:
    """Whether a thin cylinder is the edge of a face in the cloud (N, 3), or one step of the light in the views.

    `walls`: planes of the cloud, whose faces have no edge where they go on.
    """
    return is_edge_of_face(cylinder, points, views, walls) or is_one_step(Scene.of(cylinder, views, others))


def is_one_step(scene: Scene) -> bool:
    """Whether the light steps on one side of the contour alone, of which the other side is hardly seen."""
    if scene.support().weaker_share >= CONVINCING:
        return False
    samples = scene.samples()
    light = scene.light(samples, STEP_AT, SPACING)
    count = np.bincount(samples.side, minlength=2)
    if not count.all():
        return False
    outwards = np.bincount(samples.side, light[:, 0] - light[:, 1], 2) / count
    weaker, stronger = sorted(np.abs(outwards))
    return bool(weaker < (ONE_STAIR if outwards.prod() < 0.0 else ONE_STEP) * stronger)
