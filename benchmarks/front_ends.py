# SPDX-License-Identifier: Apache-2.0
"""The detector's front ends side by side on scanned sites with exact truth.

    .venv/bin/python -m benchmarks.front_ends [--seeds 21 22] [--noise-mm 1 3]

The sites are the `lab` and `field` layouts of bags/, scanned from points on their walks: what a front end finds of
each planned radius, how many radii lie within three of their stated standard deviations, what it finds that is none,
and its time. `planes` is the paper's Algorithm 3 with planes placed
by itself, `straightened` the same with its sections taken along the pipes. Prints a table and writes
results/front_ends.json beside this file.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.results.scored_files import Segment
from pipeprog_bringup.results.scoring import match, relations
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Cloud, Cylinder

sys.path.insert(0, str(Path(__file__).parents[1] / "bags"))
from sitegen.field import build_field
from sitegen.lab import build_lab
from sitegen.scan import scan
from sitegen.site import Site

RESULTS = Path(__file__).parent / "results" / "front_ends.json"
FRONT_ENDS = {
    "normals": DetectConfig(),
    "planes": DetectConfig(front_end="planes"),
    "straightened": DetectConfig(front_end="planes", straighten=True),
}
LAYOUTS = {"lab": (build_lab, 1_000_000, 1.8), "field": (build_field, 2_500_000, 2.2)}
STATIONS = 5
BIN = 0.01  # m along a pipe
DECOY_RADIUS_OFF = 0.15  # of its radius: a decoy found as what it is counts neither way


def main(seeds: list[int], noises_mm: list[float]) -> None:
    """Every front end on every site."""
    rows = []
    print("site      seed noise  front end     found    false  radius RMSE  class  seconds  found of each radius")
    for layout, (build, points, distance) in LAYOUTS.items():
        for seed in seeds:
            site = build(np.random.default_rng(seed), 1.0, 0.0, distance)
            for noise in noises_mm:
                cloud, seen = taken(site, points, 1e-3 * noise, seed)
                for name, config in FRONT_ENDS.items():
                    row: dict[str, Any] = {"site": layout, "seed": seed, "noise_mm": noise, "front_end": name}
                    row |= measured(site, cloud, seen, config)
                    rows.append(row)
                    of_each = "  ".join(f"{radius}: {found}" for radius, found in row["found_of"].items())
                    print(
                        f"{layout:8} {seed:5} {noise:5} {name:>12} {row['found']:4}/{row['pipes']:<4} {row['false']:5} "
                        f"{row['radius_rmse_mm'] or 0:9.2f} mm {row['right_class']:6} {row['seconds']:8.1f}  {of_each}",
                        flush=True,
                    )
    RESULTS.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


def taken(site: Site, points: int, noise: float, seed: int) -> tuple[Cloud, list[bool]]:
    """The site scanned from a few points on its walk, and of which pipes more than half of the length is seen."""
    rng = np.random.default_rng([seed, 1])
    low = np.min([pipe.start for pipe in site.pipes] + [pipe.end for pipe in site.pipes], axis=0) - 0.4
    high = np.max([pipe.start for pipe in site.pipes] + [pipe.end for pipe in site.pipes], axis=0) + 0.4
    path = np.array(site.waypoints)[:, :3]
    stations = path[np.linspace(0, len(path) - 1, STATIONS).astype(int)]
    aims = rng.uniform([low[0], low[1], min(low[2], -0.5)], [high[0], 0.0, high[2]], (points // STATIONS, 3))
    cloud, _, owner = scan(site.primitives, stations, aims, noise, rng)
    seen = [False] * len(site.pipes)
    for number, part in enumerate(site.primitives):
        if part.pipe >= 0:
            pipe = site.pipes[part.pipe]
            along = (cloud[owner == number] - pipe.start) @ (pipe.end - pipe.start) / pipe.length
            bins = np.floor(along / BIN).astype(int)
            seen[part.pipe] = bool(len(np.unique(bins)) * BIN > 0.5 * pipe.length)
    return Cloud(cloud), seen


def measured(site: Site, cloud: Cloud, seen: list[bool], config: DetectConfig) -> dict[str, Any]:
    """Figures of one run."""
    boq = BillOfQuantities(
        tuple(
            PipeClass(f"{1e3 * radius:g}", radius, 10.0, (1.0, 0.0, 0.0), 0.01 * radius)
            for radius in site.planned_radii
        )
    )
    started = time.process_time()
    pipes = detect(cloud, boq, config)
    seconds = time.process_time() - started
    found = [segment(pipe.cylinder, pipe.id, pipe.class_name) for pipe in pipes]
    sigmas = [pipe.radius_sigma for pipe in pipes]
    return {"points": len(cloud.points), **judged(site, seen, found, sigmas), "seconds": round(seconds, 1)}


def judged(site: Site, seen: list[bool], found: list[Segment], sigmas: Sequence[float] = ()) -> dict[str, Any]:
    """What detections with their classes are worth, held against the pipes that the cloud shows.

    sigmas [m] are the stated standard deviations of their radii, where they state any.
    """
    radii = site.planned_radii
    truth = [segment(Cylinder(pipe.start, pipe.end, pipe.radius), str(k)) for k, pipe in enumerate(site.pipes)]
    pairs = {k: j for k, j in match(found, truth).items() if seen[j]}
    decoys = [segment(Cylinder(np.asarray(a), np.asarray(b), radius), "") for a, b, radius in site.ignored]
    false = [
        pipe
        for k, pipe in enumerate(found)
        if k not in match(found, truth) and not any(is_decoy(pipe, decoy) for decoy in decoys)
    ]
    errors = [found[k].radius - truth[j].radius for k, j in pairs.items()]
    hit = [truth[j].radius for j in pairs.values()]
    visible = [pipe.radius for pipe, is_seen in zip(truth, seen, strict=True) if is_seen]
    true = [abs(error) < 3.0 * sigmas[k] for k, error in zip(pairs, errors, strict=True)] if sigmas else []
    return {
        "pipes": sum(seen),
        "found": len(pairs),
        "false": len(false),
        "right_class": sum(found[k].class_name == f"{1e3 * truth[j].radius:g}" for k, j in pairs.items()),
        "radius_rmse_mm": round(1e3 * float(np.sqrt(np.mean(np.square(errors)))), 3) if errors else None,
        **({"within_3_sigma": sum(true)} if sigmas else {}),
        "found_of": {f"{1e3 * radius:g}": f"{hit.count(radius)}/{visible.count(radius)}" for radius in radii},
    }


def segment(cylinder: Cylinder, name: str, class_name: str | None = None) -> Segment:
    """A cylinder as the score has it."""
    return Segment(cylinder.start, cylinder.end, cylinder.radius, cylinder.length, name, class_name)


def is_decoy(pipe: Segment, decoy: Segment) -> bool:
    """Whether a detection is a round thing that is no pipe, measured as such."""
    (angle,), (distance,), (overlap,) = relations(pipe, [decoy])
    alike = abs(pipe.radius - decoy.radius) < DECOY_RADIUS_OFF * decoy.radius
    return bool(alike and angle < 0.2 and distance < decoy.radius and overlap > 0.3 * pipe.length)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--noise-mm", type=float, nargs="+", default=[1.0, 3.0])
    arguments = parser.parse_args()
    main(arguments.seeds, arguments.noise_mm)
