# SPDX-License-Identifier: Apache-2.0
"""What is told of planned pipes that nobody found: on generated sites with a curtain, a closed door, a leg not walked.

    .venv/bin/python -m benchmarks.coverage

A third of each site's pipes are planned and not installed, and a third of the others count as missed by the detector.
The cloud is what rays of the keyframes meet, with the noise of stereo and without the thinnest class, which stereo
loses before a wall. Each planned pipe is then told as installed, missing, unclear, hidden or not seen, and rays through
the whole site say what was in view. Writes results/coverage.json.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.survey import RESULTS, commit
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.coverage.planned import PlannedCoverage, planned_coverage
from pipeprog_detect.coverage.survey import views_of
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import FoundPipe, installed_where_planned
from pipeprog_detect.types import Cylinder, View

sys.path.insert(0, str(Path(__file__).parents[1] / "bags"))

from sitegen.field import build_field
from sitegen.lab import build_lab
from sitegen.render import Lens, Scene, build_scene, trace
from sitegen.site import PLASTER, Site
from sitegen.walk import Walk

SEEDS = (3, 5, 8)
LENS = Lens(1280, 720, 914.0, 914.0, 639.5, 359.5)
REDUCED = 4  # of the images that rays are cast for: 320 x 180 rays
PERIOD = 0.8  # s between keyframes at 0.75 m/s, as the selector takes them two metres from a wall
NOISE = 0.004  # m, of the depth maps two metres from a wall
THIN = 0.02  # m; stereo loses thinner pipes before a wall
PART = 0.02  # m of an axis that rays are counted on
LEAST_FRAMES = 3  # two views give a depth, a third confirms it
FOUND_SHARE = 0.6  # of a pipe's length in view that the detector is taken to need


def main() -> None:
    """Print the rows and write results/coverage.json."""
    rows: list[dict[str, Any]] = []
    for layout in ("lab", "field"):
        for case in ("curtain", "closed door", "leg not walked"):
            counts: Counter[str] = Counter()
            for seed in SEEDS:
                counts.update(measured(layout, case, seed))
            rows.append({"site": layout, "case": case, "seeds": len(SEEDS), **counts})
            print(rows[-1])
    total: Counter[str] = Counter()
    for row in rows:
        total.update({key: value for key, value in row.items() if key not in ("site", "case", "seeds")})
    hidden = total["out of sight"]
    result = {
        "title": "Seen and not seen: what is told of planned pipes that were not found",
        "command": ".venv/bin/python -m benchmarks.coverage",
        "findings": {
            "pipes out of sight told as hidden or not seen [%]": round(100 * total["of these told so"] / hidden, 1),
            "installed pipes in view told as missing": total["of these told as missing"],
            "pipes in view and not installed told as missing [%]": round(
                100 * total["of these told as missing, rightly"] / total["not installed, in view"], 1
            ),
        },
        "rows": rows,
        "commits": [commit()],
    }
    (RESULTS / "coverage.json").write_text(json.dumps(result, indent=1) + "\n")
    print(result["findings"])


def measured(layout: str, case: str, seed: int) -> dict[str, int]:
    """Counts of one site's planned pipes by what is true of them and what is told."""
    rng = np.random.default_rng(seed)
    site = (build_field if layout == "field" else build_lab)(rng, 1.0, 0.0, 2.0)
    poses = walked(site, case, layout)
    absent = rng.random(len(site.pipes)) < 1 / 3
    missed = rng.random(len(site.pipes)) < 1 / 3
    seen = parts_in_view(site, poses)
    planned = [
        PlannedPipe(f"{n}", f"{n}", Cylinder(pipe.start, pipe.end, pipe.radius), f"{1e3 * pipe.radius:g}", 0)
        for n, pipe in enumerate(site.pipes)
    ]
    found = [
        FoundPipe(f"p{n}", barrel, planned[n].class_name)
        for n, own in enumerate(seen)
        if not (absent[n] or missed[n]) and own.mean() >= FOUND_SHARE
        for barrel in [planned[n].cylinder.cut(*(np.flatnonzero(own)[[0, -1]] + [0, 1]) * PART)]
    ]
    told = planned_coverage(installed_where_planned(planned, found), views(site, absent, poses))
    return counted(told, seen, absent)


def counted(told: list[PlannedCoverage], seen: list[NDArray[np.bool_]], absent: NDArray[np.bool_]) -> dict[str, int]:
    """The row's counts; a pipe is out of sight with at most a tenth of it in view, and in view with nine tenths."""
    share = np.array([own.mean() for own in seen])
    word = np.array([one.word for one in told])
    out, into = share <= 0.1, share >= 0.9
    thick = np.array([one.planned.cylinder.radius > THIN for one in told])
    return {
        "pipes": len(told),
        "out of sight": int(out.sum()),
        "of these told so": int(np.isin(word[out], ("hidden", "not_seen")).sum()),
        "installed, in view, not found": int((into & ~absent & (word != "installed")).sum()),
        "of these told as missing": int((~absent & (word == "missing")).sum()),
        "not installed, in view": int((into & absent & thick).sum()),
        "of these told as missing, rightly": int((into & absent & thick & (word == "missing")).sum()),
    }


def walked(site: Site, case: str, layout: str) -> FloatArray:
    """Poses (N, 4, 4) of the keyframes; puts the case's curtain or door into the site."""
    width = 10.0 if layout == "field" else 5.0
    stop = math.inf
    if case == "curtain":
        site.wall((0.4 * width, -1.25, 1.2), (0, -1, 0), 0.25 * width, 2.4, PLASTER)
    elif case == "closed door":
        stop = 0.52 * width if layout == "field" else 1.3
        site.wall((stop + 0.4, -2.3, 1.6), (-1, 0, 0), 4.6, 3.2, PLASTER)
    else:
        stop = 0.4 * width if layout == "field" else 0.9
    waypoints = [point for point in site.waypoints if point[0] < stop]
    walk = Walk(waypoints, 0.75, np.random.default_rng(0), False, 0.5)
    return walk.poses(np.arange(0.0, walk.duration, PERIOD))


def parts_in_view(site: Site, poses: FloatArray) -> list[NDArray[np.bool_]]:
    """Of each pipe, which of its parts three keyframes show where all pipes are installed."""
    scene, lens = _scene(site, np.zeros(len(site.pipes), bool), 0.0), LENS.reduced(REDUCED)
    counts = [np.zeros(max(math.ceil(pipe.length / PART), 1), np.int64) for pipe in site.pipes]
    for pose in poses:
        hit, points, _ = trace(scene, lens, pose)
        owner = np.where(hit >= 0, scene.pipes[hit], -1)
        for index in np.unique(owner[owner >= 0]):
            pipe = site.pipes[index]
            along = (points[owner == index] - pipe.start) @ ((pipe.end - pipe.start) / pipe.length)
            counts[index][np.unique(np.clip((along / PART).astype(np.int64), 0, len(counts[index]) - 1))] += 1
    return [count >= LEAST_FRAMES for count in counts]


def views(site: Site, absent: NDArray[np.bool_], poses: FloatArray) -> list[View]:
    """The keyframes with the depths of the cloud of what is installed."""
    scene, lens, rng = _scene(site, absent, THIN), LENS.reduced(REDUCED), np.random.default_rng(1)
    points = []
    for pose in poses:
        hit, where, _ = trace(scene, lens, pose)
        rays = where[hit >= 0] - pose[:3, 3]
        distance = np.linalg.norm(rays, axis=1)[:, None]
        points.append(pose[:3, 3] + rays * (1 + NOISE / 2.0 * rng.standard_normal((len(rays), 1)) * distance / 2.0))
    camera = Camera(LENS.width, LENS.height, LENS.fx, LENS.fy, LENS.cx, LENS.cy)
    return views_of([camera] * len(poses), poses, np.concatenate(points))


def _scene(site: Site, absent: NDArray[np.bool_], thinnest: float) -> Scene:
    """What is to be met by rays: all but absent pipes and those thinner than `thinnest` [m]."""
    out = absent | np.array([pipe.radius < thinnest for pipe in site.pipes])
    return build_scene([p for p in site.primitives if p.pipe < 0 or not out[p.pipe]], site.lamps, site.ambient, 0)


if __name__ == "__main__":
    main()
