# SPDX-License-Identifier: Apache-2.0
"""Time and memory of the detector, stage by stage, as the cloud grows.

    .venv/bin/python -m benchmarks.cost [--points 0.3 1 3 12]

One scanned field site (58 pipes), scanned ever more densely; each size runs in a process of its own, for its memory.
What is kept is in out/cost. Writes results/cost.json with an exponent for each stage: time grows as points to that
power. How the mapper grows with the time of filming is benchmarks.map_growth.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np

from benchmarks.front_ends import LAYOUTS, STATIONS, taken
from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS, commit
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass

KEPT = ROOT / "out" / "cost"
SEED = 21
NOISE = 0.002  # m
MILLION = 1_000_000


def main() -> None:
    """Measure each size that is not known, fit, and write the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.cost", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=float, nargs="+", default=[0.3, 1.0, 3.0, 12.0], help="millions")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        print(json.dumps(_measured(arguments.one)))
        return
    KEPT.mkdir(parents=True, exist_ok=True)
    sizes = []
    for millions in arguments.points:
        kept = KEPT / f"{millions:g}.json"
        if not kept.exists():
            command = [sys.executable, "-m", "benchmarks.cost", "--one", str(millions)]
            done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
            kept.write_text(done.stdout.splitlines()[-1] + "\n")
        sizes.append(json.loads(kept.read_text()))
        print(sizes[-1], flush=True)
    content = {
        "title": "CPU time [s] and memory of the detector by points of the cloud",
        "command": "python -m benchmarks.cost",
        "commits": sorted({size["commit"] for size in sizes}),
        "rows": _rows(sizes),
    }
    (RESULTS / "cost.json").write_text(json.dumps(content, indent=1) + "\n")


def _measured(millions: float) -> dict[str, Any]:
    """CPU seconds of each stage on a scan of about `millions` million points, and the process's peak memory."""
    build, _, distance = LAYOUTS["field"]
    site = build(np.random.default_rng(SEED), 1.0, 0.0, distance)
    radii = site.planned_radii
    boq = BillOfQuantities(
        tuple(PipeClass(f"{1e3 * radius:g}", radius, 10.0, (1.0, 0.0, 0.0), 0.01 * radius) for radius in radii)
    )
    small, _ = taken(site, 20 * STATIONS * 1000, NOISE, SEED)
    detect(small, boq, DetectConfig())  # compiles
    cloud, _ = taken(site, round(millions * MILLION), NOISE, SEED)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    told: list[tuple[float, str]] = []
    detect(cloud, boq, DetectConfig(), progress=lambda _, stage: told.append((time.process_time(), stage)))
    stages: dict[str, float] = {}
    for (started, stage), (ended, _) in itertools.pairwise(told):
        name = "looking for pipes in patches" if "patches" in stage else stage
        stages[name] = stages.get(name, 0.0) + ended - started
    return {
        "points": len(cloud.points),
        "stages": {stage: round(seconds, 2) for stage, seconds in stages.items()},
        "whole": round(told[-1][0] - told[0][0], 2),
        "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "memory_before_mib": before // 1024,
        "commit": commit(),
    }


def _rows(sizes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each stage: its seconds at each size, and the exponent."""
    points = [size["points"] for size in sizes]
    quantities = {stage: [size["stages"].get(stage, 0.0) for size in sizes] for stage in sizes[-1]["stages"]}
    quantities["whole"] = [size["whole"] for size in sizes]
    quantities["peak memory [MiB]"] = [size["memory_mib"] for size in sizes]
    return [
        {
            "stage": stage,
            **{f"{count / MILLION:.2f} M": value for count, value in zip(points, values, strict=True)},
            "exponent": _exponent(points, values),
        }
        for stage, values in quantities.items()
    ]


def _exponent(points: list[int], values: list[float]) -> float | None:
    """Slope of the logarithms; none where a stage is too short to be timed."""
    if len(points) < 2 or min(values) < 0.05:
        return None
    return round(float(np.polyfit(np.log(points), np.log(values), 1)[0]), 2)


if __name__ == "__main__":
    main()
