# SPDX-License-Identifier: Apache-2.0
"""Which views a view is matched with."""

from __future__ import annotations

import numpy as np
from scenes import BASE, CAMERA, STEP, centre, keyframe, pose, started, view

from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.guided_matching import link, partners


def place(model: SparseModel, one: Keyframe, x: float) -> int:
    """Adds a keyframe at its true pose, tied to nothing; returns its view."""
    first, unit = pose(0.0), np.linalg.norm(centre(pose(BASE)) - centre(pose(0.0)))
    camera_from_model = pose(x) @ np.linalg.inv(first)
    camera_from_model[:3, 3] /= unit
    return model.add_view(one.stamp, one.rays, one.focal, camera_from_model)


def test_partners_are_near_in_time_or_look_at_the_same_place() -> None:
    model = started(0, 1)
    keyframes = {n * STEP: keyframe(n) for n in (0, 1, 2, 13, 14, 15, 16)}
    for n in (2, 13, 14, 15, 16):
        place(model, keyframe(n), BASE * n)
    # The first view: three neighbours in time, and nothing of what lies 3 m on.
    assert sorted(partners(model, 0, keyframes)) == [1, 2, 3]
    # The camera is back where it began: its points are those of the first view.
    back = Keyframe.of(30 * STEP, view(pose(0.0), 30), CAMERA)
    last = place(model, back, 0.0)
    keyframes[back.stamp] = back
    model.point_of[model.features(last)][:50] = model.seen(0)[:50]
    found = partners(model, last, keyframes)
    assert found[:3] == [6, 5, 4]
    assert {0, 1} <= set(found[3:])


def test_a_view_that_sees_no_point_is_not_linked() -> None:
    model = started(0, 1)
    last = place(model, keyframe(2), 2 * BASE)
    link(model, last, {n * STEP: keyframe(n) for n in range(3)})
    assert not len(model.seen(last))
