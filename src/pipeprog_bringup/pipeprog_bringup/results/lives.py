# SPDX-License-Identifier: Apache-2.0
"""One id for a pipe's whole life: pipes of a survey recognised among those of its reference."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from pipeprog_detect.coverage.changes import KnownPipe, changes
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, View
from pipeprog_sfm.alignment.survey_map import MappedPipe, SurveyMap

NUMBERED = re.compile(r"p(\d{2,9})")  # an id as pipeprog gives it; those of other programs have no number


@dataclass(frozen=True)
class Lives:
    """Of each pipe of a survey by its id, the id for its life; and those known before that nobody has seen since."""

    of: dict[str, str]
    unseen: tuple[MappedPipe, ...] = ()


def lives_after(reference: SurveyMap, product: Product, views: Sequence[View]) -> Lives:
    """The lives of a survey in the frame of its reference; `views`: its keyframes with depths.

    A pipe that was not there before gets the next free number.
    """
    # Pieces of one pipe have one life, and are compared each by itself.
    before = [
        KnownPipe(pipe.life, Cylinder(pipe.ends[0], pipe.ends[1], pipe.radius), pipe.class_name)
        for pipe in reference.pipes
    ]
    after = [KnownPipe(pipe.id, pipe.cylinder, pipe.class_name or "") for pipe in product.pipes]
    told = changes(before, after, views)
    most = max((int(found[1]) for pipe in before if (found := NUMBERED.fullmatch(pipe.id))), default=0)
    of: dict[str, str] = {}
    for change in told:
        if not change.before:
            most += 1
        life = change.before[0] if change.before else f"p{most:02d}"
        of |= dict.fromkeys(change.after, life)
    unseen = [pipe for pipe, change in zip(reference.pipes, told, strict=False) if change.state == "not_seen"]
    return Lives(of, tuple(unseen))
