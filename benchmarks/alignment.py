# SPDX-License-Identifier: Apache-2.0
"""Surveys in the frame of an earlier one: the same generated site a night later, and other rooms.

    .venv/bin/python -m benchmarks.alignment

The second night has a pipe more, one less and one longer, other light and clutter, and no board; the other rooms are
labs of other seeds, furnished alike. Keyframes go through the sparse stage, and their models are aligned with the map
of the first night, whose frame is that of the truth. Writes results/alignment.json.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.survey import RESULTS, commit
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.alignment.alignment import align
from pipeprog_sfm.alignment.placing import NotAlignedError
from pipeprog_sfm.alignment.survey_map import SurveyMap, sparse_part
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.sparse.mapper import Mapper

sys.path.insert(0, str(Path(__file__).parents[1] / "bags"))

from sitegen.lab import build_lab
from sitegen.night import second_night
from sitegen.render import Lens, build_scene
from sitegen.sensor import Sensor, develop, expose
from sitegen.walk import Walk

SITES = (31, 33)
OTHER_ROOMS = range(201, 221)
LENS = Lens(480, 270, 342.7, 342.7, 239.5, 134.5)  # 70 degrees across; three eighths of 720p
PERIOD = 0.6  # s between keyframes, 0.45 m of the walk
KEYFRAMES, KEYFRAMES_ELSEWHERE = 24, 6
NIGHT_SEED = 1 << 21
WALL = (2.0, 0.0, 1.2)  # m; the middle of the pipes, where a displacement is told


@dataclass(frozen=True)
class Filmed:
    """A model of the sparse stage, and the true (4, 4) map_from_camera of its keyframes by stamp."""

    mapper: Mapper
    truth: dict[int, FloatArray]

    @property
    def true_similarity(self) -> FloatArray:
        """(4, 4) map_from_model by the places of the cameras."""
        model = self.mapper.map.published
        return similarity(model.centres(), np.array([self.truth[stamp][:3, 3] for stamp in model.stamps]))


def main() -> None:
    """Print the rows and write results/alignment.json."""
    rows: list[dict[str, Any]] = []
    for seed in SITES:
        earlier = as_reference(filmed(seed, KEYFRAMES, is_second_night=False))
        rows.append({"seed": seed, "night": "the same site"} | measured(earlier, seed, KEYFRAMES, is_second_night=True))
        print(rows[-1], flush=True)
        if seed == SITES[0]:
            for other in OTHER_ROOMS:
                told = measured(earlier, other, KEYFRAMES_ELSEWHERE, is_second_night=False)
                rows.append({"seed": other, "night": "another room"} | told)
                print(rows[-1], flush=True)
    same = [row for row in rows if row["night"] == "the same site"]
    elsewhere = [row for row in rows if row["night"] == "another room"]
    result = {
        "title": "Surveys in the frame of an earlier one",
        "command": ".venv/bin/python -m benchmarks.alignment",
        "findings": {
            "nights aligned": sum(row["aligned by"] != "" for row in same),
            "largest displacement at the pipes [mm]": max(row["displacement [mm]"] or 0.0 for row in same),
            "largest turn [deg]": max(row["turn [deg]"] or 0.0 for row in same),
            "other rooms told as not aligned": sum(row["aligned by"] == "" for row in elsewhere),
            "other rooms": len(elsewhere),
        },
        "rows": rows,
        "commits": [commit()],
    }
    (RESULTS / "alignment.json").write_text(json.dumps(result, indent=1) + "\n")
    print(result["findings"])


def filmed(seed: int, count: int, is_second_night: bool) -> Filmed:
    """The sparse stage on a walk past a lab."""
    rng = np.random.default_rng(seed)
    site = build_lab(rng, 1.0, 0.0, 2.0)
    if is_second_night:
        rng = np.random.default_rng([seed, NIGHT_SEED])
        second_night(site, rng)
    scene = build_scene(site.primitives, site.lamps, site.ambient, seed)
    walk, sensor = Walk(site.waypoints, 0.75, rng, site.closed_walk, 1.0), Sensor(gain=site.gain)
    camera = Camera(LENS.width, LENS.height, LENS.fx, LENS.fy, LENS.cx, LENS.cy)
    mapper, truth = Mapper(MapperConfig()), {}
    for number in range(count):
        moment = number * PERIOD
        stamp = round(1e9 * moment)
        image = develop(expose(scene, LENS, walk, sensor, moment), sensor, rng)
        mapper.add(stamp, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), camera)
        truth[stamp] = walk.poses([moment])[0]
    mapper.finish()
    return Filmed(mapper, truth)


def as_reference(night: Filmed) -> SurveyMap:
    """The map of a night, placed by its truth."""
    placed = night.true_similarity
    scale = float(np.cbrt(np.linalg.det(placed[:3, :3])))
    survey = sparse_part(night.mapper.map.published, night.mapper.map.keyframes, placed, scale)
    return replace(survey, scale_sigma=0.0003)


def measured(earlier: SurveyMap, seed: int, count: int, is_second_night: bool) -> dict[str, Any]:
    """How a night lies in the frame of an earlier one; empty figures where it is not aligned."""
    night = filmed(seed, count, is_second_night)
    model = night.mapper.map.published
    started = time.perf_counter()
    try:
        found = align(model, night.mapper.map.keyframes, (), earlier)
    except NotAlignedError as error:
        figures = dict.fromkeys(("displacement [mm]", "turn [deg]", "scale [%]", "sigma of the scale [%]", "shared"))
        return {"aligned by": "", **figures, "reason": str(error), "seconds": round(time.perf_counter() - started, 1)}
    pose = found.reference_from_model
    places = model.centres() @ pose[:3, :3].T + pose[:3, 3]
    moved = similarity(np.array([night.truth[stamp][:3, 3] for stamp in model.stamps]), places)
    scale = float(np.cbrt(np.linalg.det(moved[:3, :3])))
    shift = moved[:3, :3] @ WALL + moved[:3, 3] - WALL
    angle = np.arccos(np.clip((np.trace(moved[:3, :3]) / scale - 1) / 2, -1.0, 1.0))
    return {
        "aligned by": found.by,
        "displacement [mm]": round(1e3 * float(np.linalg.norm(shift)), 2),
        "turn [deg]": round(float(np.degrees(angle)), 4),
        "scale [%]": round(100 * (scale - 1), 4),
        "sigma of the scale [%]": round(100 * found.scale_sigma, 4),
        "shared": found.shared,
        "reason": "",
        "seconds": round(time.perf_counter() - started, 1),
    }


if __name__ == "__main__":
    main()
