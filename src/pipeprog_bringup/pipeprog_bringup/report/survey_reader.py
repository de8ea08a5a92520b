# SPDX-License-Identifier: Apache-2.0
"""A survey as its folder holds it, read back for the report."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.report import render
from pipeprog_bringup.results.results_reader import UNPLANNED, read_results
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Stamps before this count from some other zero than 1970 (a video, a simulation).
FIRST_CLOCK = 1_000_000_000 * 10**9


@dataclass(frozen=True)
class Survey:
    """A run as its folder holds it."""

    name: str
    time: datetime
    pipes: list[dict[str, Any]]
    classes: list[dict[str, Any]]
    scale: dict[str, Any]
    facts: dict[str, Any]
    colors: dict[str, render.Color]
    positions: FloatArray | None
    cloud: Path | None = field(default=None)

    def color(self, name: str | None) -> render.Color:
        """Colour of a class, grey for pipes without one."""
        return self.colors.get(name or "", UNPLANNED)

    def cylinder(self, pipe: dict[str, Any]) -> Cylinder:
        """Geometry of an entry of pipes.json."""
        return Cylinder(np.array(pipe["start"], float), np.array(pipe["end"], float), float(pipe["radius"]))


def read_survey(folder: Path) -> Survey:
    """The results of one run; only pipes.json must be there."""
    results = read_results(folder)
    poses = results.map_from_camera
    return Survey(
        name=folder.resolve().name,
        time=_time(results.stamps, results.facts, folder),
        pipes=results.pipes,
        classes=results.classes,
        scale=results.scale,
        facts=results.facts,
        colors=results.colors,
        positions=poses[:, :3, 3] if len(poses) else None,
        cloud=results.cloud_path,
    )


def _time(stamps: NDArray, facts: dict[str, Any], folder: Path) -> datetime:
    """When the survey was taken; for recordings without a clock, when it was worked out."""
    if len(stamps) and stamps[0] > FIRST_CLOCK:
        return datetime.fromtimestamp(stamps[0] * 1e-9, timezone.utc)
    try:
        return datetime.fromisoformat(str(facts["finished"])).astimezone(timezone.utc)
    except (KeyError, OverflowError, ValueError):  # none, no date, or one at an end of the calendar
        return datetime.fromtimestamp((folder / "pipes.json").stat().st_mtime, timezone.utc)
