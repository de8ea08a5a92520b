"""A survey as its folder holds it, read back for the report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import yaml
from numpy.typing import NDArray

from pipeprog_bringup.report import render
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_bringup.results.scoring import read_json
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.types import Cylinder

UNPLANNED: render.Color = (0.55, 0.55, 0.58)
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
    if not folder.is_dir():
        raise InputError(f"no such folder: {folder}")
    if not (folder / "pipes.json").is_file():
        raise InputError(f"{folder} holds no pipes.json: give the --out of a replay or detect")
    content = read_json(folder / "pipes.json")
    try:
        pipes, classes = list(content["pipes"]), list(content["classes"])
        for pipe in pipes:
            values = (*pipe["start"], *pipe["end"], pipe["radius"], pipe["length"], pipe["radius_sigma"], pipe["rmse"])
            _ = [float(value) for value in values if value is not None], pipe["id"], pipe["class"]
        for entry in classes:
            _ = [float(entry[key]) for key in ("outer_radius", "planned_m", "installed_m")], entry["class"]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder / 'pipes.json'} is no pipes.json of pipeprog ({error}): run it again") from None
    facts = _optional_json(folder / "run.json")
    has_trajectory = (folder / "trajectory.tum").is_file()
    stamps, poses = read_trajectory(folder / "trajectory.tum") if has_trajectory else (np.empty(0), np.empty(0))
    cloud = folder / "cloud.ply" if (folder / "cloud.ply").is_file() else Path(str(facts.get("cloud", "")))
    return Survey(
        name=folder.resolve().name,
        time=_time(stamps, facts, folder),
        pipes=pipes,
        classes=classes,
        scale=content.get("scale", {}),
        facts=facts,
        colors=_colors(folder / "config.yaml", classes),
        positions=poses[:, :3, 3] if len(poses) else None,
        cloud=cloud if cloud.is_file() else None,
    )


def _time(stamps: NDArray, facts: dict[str, Any], folder: Path) -> datetime:
    """When the survey was taken; for recordings without a clock, when it was worked out."""
    if len(stamps) and stamps[0] > FIRST_CLOCK:
        return datetime.fromtimestamp(stamps[0] * 1e-9, timezone.utc)
    try:
        return datetime.fromisoformat(str(facts["finished"])).astimezone(timezone.utc)
    except (KeyError, ValueError):
        return datetime.fromtimestamp((folder / "pipes.json").stat().st_mtime, timezone.utc)


def _colors(config: Path, classes: Sequence[dict[str, Any]]) -> dict[str, render.Color]:
    """Colour of each class as config.yaml has it; without that, colours that can be told apart."""
    palette = mpl.color_sequences["tab10"]
    colors = {str(entry["class"]): tuple(palette[i % 10]) for i, entry in enumerate(classes)}
    try:
        for entry in yaml.safe_load(config.read_text())["boq"]:
            text = str(entry["color"]).lstrip("#")
            colors[str(entry["name"])] = tuple(int(text[i : i + 2], 16) / 255 for i in (0, 2, 4))
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
        pass
    return colors


def _optional_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
