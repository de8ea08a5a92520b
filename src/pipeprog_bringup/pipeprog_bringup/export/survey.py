# SPDX-License-Identifier: Apache-2.0
"""What is exported: a results folder in the coordinates that the user wants."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.results.plan_file import read_plan
from pipeprog_bringup.results.results_reader import Results
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.installed_where_planned import FoundPipe, PlannedState, installed_where_planned
from pipeprog_detect.types import Cylinder

NO_TIME = "2000-01-01T00:00:00+00:00"  # of results that do not tell when they were made
_FAR = 10_000.0  # m; beyond, numbers of single precision are 1 mm apart and more


@dataclass(frozen=True)
class SurveyPipe:
    """A pipe to export: its row of pipes.json, its place [m], the id of its run (empty without one)."""

    row: dict[str, Any]
    cylinder: Cylinder
    run: str

    @property
    def id(self) -> str:
        """`p01`, `p02`, ..."""
        return str(self.row["id"])

    @property
    def class_name(self) -> str:
        """Name of the planned class, empty where it has none."""
        return str(self.row["class"] or "")


@dataclass(frozen=True)
class BillLineRow:
    """A line of the bill as config.yaml keeps it; texts are empty where they are not given."""

    class_name: str
    name: str
    planned: float
    system: str
    zone: str
    activity: str
    start: str
    finish: str
    material: str


@dataclass(frozen=True)
class Site:
    """The coordinates that results are exported in.

    Attributes:
        site_from_map: (4, 4) rigid transform.
        crs: name of the coordinate reference system, such as `EPSG:25832`; empty where none is given.
    """

    site_from_map: FloatArray = field(default_factory=lambda: np.eye(4))
    crs: str = ""

    @property
    def origin(self) -> FloatArray:
        """(3,) whole hundreds of metres that formats with single precision take off; 0 near the origin."""
        place = self.site_from_map[:3, 3]
        return np.round(place, -2) if np.abs(place).max() > _FAR else np.zeros(3)

    def place(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of the map in site coordinates [m]."""
        return points @ self.site_from_map[:3, :3].T + self.site_from_map[:3, 3]


@dataclass(frozen=True)
class Survey:
    """The results of a run, and the coordinates to export them in."""

    results: Results
    site: Site = Site()

    @cached_property
    def pipes(self) -> list[SurveyPipe]:
        """The pipes, in the order of pipes.json."""
        run_of = {pipe: str(run.get("id", "")) for run in self.results.runs for pipe in _texts(run.get("pipes"))}
        places = (self.site.place(np.array([one.start, one.end])) for one in self.results.cylinders)
        return [
            SurveyPipe(row, Cylinder(start, end, float(row["radius"])), run_of.get(row["id"], ""))
            for row, (start, end) in zip(self.results.pipes, places, strict=True)
        ]

    @cached_property
    def lines(self) -> list[BillLineRow]:
        """The lines of the bill; of a class that config.yaml tells no lines of, the class itself."""
        told = {}
        entries = self.results.config.get("boq")
        for entry in entries if isinstance(entries, list) else []:
            if isinstance(entry, dict) and isinstance(entry.get("lines"), list):
                told[str(entry.get("name"))] = [line for line in entry["lines"] if isinstance(line, dict)]
        rows = []
        for row in self.results.classes:
            name = str(row["class"])
            for line in told.get(name) or [{"name": name, "planned_length_m": row["planned_m"]}]:
                rows.append(_line(name, line))
        return rows

    @cached_property
    def planned(self) -> list[PlannedState]:
        """What was found of each planned pipe; empty where the plan has no places.

        Plan and results are compared in site coordinates; without control points, these are those of the map.
        """
        path = self.results.folder / "plan.json"
        if not path.is_file():
            return []
        found = [FoundPipe(pipe.id, pipe.cylinder, pipe.class_name) for pipe in self.pipes]
        return installed_where_planned(read_plan(path), found)

    @property
    def finished(self) -> str:
        """When the run ended, ISO 8601 in UTC; empty where run.json does not tell."""
        return str(self.results.facts.get("finished", ""))

    @property
    def recording(self) -> str:
        """Name of the recording or cloud, empty where run.json does not tell."""
        return Path(str(self.results.facts.get("bag", self.results.facts.get("cloud", "")))).name


def along_axis(cylinder: Cylinder, origin: FloatArray) -> FloatArray:
    """(4, 4) with z along the axis, its origin at the start less `origin` (3,), x level."""
    axis = cylinder.axis
    level = np.cross([0.0, 0.0, 1.0], axis)
    if np.linalg.norm(level) < 1e-6:
        level = np.array([1.0, 0.0, 0.0])
    x = level - (level @ axis) * axis
    x /= np.linalg.norm(x)
    placement = np.eye(4)
    placement[:3, 0], placement[:3, 1], placement[:3, 2] = x, np.cross(axis, x), axis
    placement[:3, 3] = cylinder.start - origin
    return placement


def _line(class_name: str, line: dict[str, Any]) -> BillLineRow:
    planned = line.get("planned_length_m")
    texts = (str(line.get(key, "")) for key in ("system", "zone", "activity", "start", "finish", "material"))
    length = float(planned) if isinstance(planned, int | float) else 0.0
    return BillLineRow(class_name, str(line.get("name", class_name)), length, *texts)


def _texts(value: Any) -> list[str]:
    return [text for text in value if isinstance(text, str)] if isinstance(value, list) else []
