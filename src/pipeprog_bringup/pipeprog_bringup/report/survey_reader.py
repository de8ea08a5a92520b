# SPDX-License-Identifier: Apache-2.0
"""A survey as its folder holds it, read back for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.results.results_reader import UNPLANNED, Color, Results, read_results
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.types import Cylinder

# Stamps before this count from some other zero than 1970 (a video, a simulation).
FIRST_CLOCK = 1_000_000_000 * 10**9


@dataclass(frozen=True)
class Survey:
    """The results of one run, with the name and the time that the report gives them."""

    name: str
    time: datetime
    results: Results

    @property
    def pipes(self) -> list[dict[str, Any]]:
        """Rows of pipes.json, one a pipe."""
        return self.results.pipes

    @property
    def classes(self) -> list[dict[str, Any]]:
        """Rows of pipes.json, one a planned class."""
        return self.results.classes

    @property
    def scale(self) -> dict[str, Any]:
        """Where the metres come from."""
        return self.results.scale

    @property
    def facts(self) -> dict[str, Any]:
        """run.json, how the run went."""
        return self.results.facts

    @property
    def cylinders(self) -> list[Cylinder]:
        """Geometry of the pipes, in their order."""
        return self.results.cylinders

    @property
    def positions(self) -> FloatArray | None:
        """(M, 3) places of the camera [m], None where the run has no cameras."""
        poses = self.results.map_from_camera
        return poses[:, :3, 3] if len(poses) else None

    @cached_property
    def installed(self) -> dict[str, float]:
        """Metres installed of each class."""
        return {str(entry["class"]): float(entry["installed_m"]) for entry in self.classes}

    def color(self, name: str | None) -> Color:
        """Colour of a class, grey for pipes without one."""
        return self.results.colors.get(name or "", UNPLANNED)

    def cylinder(self, pipe: dict[str, Any]) -> Cylinder:
        """Geometry of an entry of pipes.json."""
        return Cylinder(np.array(pipe["start"], float), np.array(pipe["end"], float), float(pipe["radius"]))


def read_survey(folder: Path) -> Survey:
    """The results of one run; only pipes.json must be there."""
    results = read_results(folder)
    return Survey(folder.resolve().name, _time(results), results)


def read_surveys(folders: Sequence[Path]) -> list[Survey]:
    """The surveys of several runs, in the order of their dates; raises InputError where a folder is given twice."""
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("a folder is given twice: give each survey once")
    return sorted((read_survey(folder) for folder in folders), key=lambda survey: (survey.time, survey.name))


def _time(results: Results) -> datetime:
    """When the survey was taken; for recordings without a clock, when it was worked out."""
    if len(results.stamps) and results.stamps[0] > FIRST_CLOCK:
        return datetime.fromtimestamp(results.stamps[0] * 1e-9, timezone.utc)
    try:
        return datetime.fromisoformat(str(results.facts["finished"])).astimezone(timezone.utc)
    except (KeyError, OverflowError, ValueError):  # none, no date, or one at an end of the calendar
        return datetime.fromtimestamp((results.folder / "pipes.json").stat().st_mtime, timezone.utc)
