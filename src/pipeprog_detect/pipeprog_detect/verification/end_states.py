# SPDX-License-Identifier: Apache-2.0
"""What is at the ends of a measured pipe, and how well their places are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_detect.cloud.axial_extent import bin_length
from pipeprog_detect.refinement.end_posterior import end_posterior
from pipeprog_detect.refinement.extension import LEAST
from pipeprog_detect.types import Cylinder, PipeEnd, View
from pipeprog_detect.verification.planes_met import ON_PLANE
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.wall_ends import planes_ahead


def ends_in_views(
    cylinder: Cylinder, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> tuple[PipeEnd, PipeEnd]:
    """The start and the end of a measured pipe, as the keyframes and the planes of the `context` tell.

    An end that they leave open by more than what is left to the search for end rims is hidden, or out of view.
    """
    start, end = (_end_in_views(cylinder, at_end, context, views, others) for at_end in (False, True))
    return start, end


def ends_in_cloud(cylinder: Cylinder, points: int) -> tuple[PipeEnd, PipeEnd]:
    """The same of a pipe of which the cloud alone shows this many points: they tell an end to a bin along the axis."""
    end = PipeEnd(bin_length(cylinder.radius, points / cylinder.length))
    return end, end


def _end_in_views(
    cylinder: Cylinder, at_end: bool, context: SceneContext, views: Sequence[View], others: Sequence[Cylinder]
) -> PipeEnd:
    posterior = end_posterior(cylinder, at_end, views, others)
    # A plane on which the end lies is one ahead of a slightly shorter pipe.
    shorter = cylinder.cut(ON_PLANE, cylinder.length - ON_PLANE)
    wall = min(
        (ahead for ahead in planes_ahead(shorter, at_end, context, views, others) if ahead > 0.0), default=np.inf
    )
    sigma = posterior.sigma(max(wall - ON_PLANE, 0.0))
    if wall < 2.0 * ON_PLANE:
        return PipeEnd(sigma, "wall")
    if sigma < LEAST:
        return PipeEnd(sigma, "free")
    return PipeEnd(sigma, "hidden" if posterior.in_view else "out_of_view")
