# SPDX-License-Identifier: Apache-2.0
"""Public detectors of pipes beside ours: the same scanned clouds, the same scorer, one run.

    .venv/bin/python -m benchmarks.peers [--seeds 21] [--noise-mm 1 3] [--layouts lab field]

The peers are what the Python registry has as wheels; they get an environment of their own in out/peers-venv. What is
measured is kept in out/peers, so that an interrupted run goes on. Those that would have to be built (PCL, Schnabel's
engine, CylinderDetection) are quoted: they ran on other clouds, see `source`. cylfit 0.1.0 was tried, too, and
stopped without a result on a lab after nine minutes on a busy machine. Writes results/peers.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.front_ends import LAYOUTS, judged, measured, segment, taken
from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.results.scored_files import Segment
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.types import Cylinder

ENVIRONMENT = ROOT / "out" / "peers-venv"
PACKAGES = (
    "cgal==6.0.1.post202410241521",
    "pyransac3d==0.7.0",
    "numpy==2.2.6",
    "scipy==1.15.3",
)
PEERS = {
    "cgal": "CGAL 6.0.1, Efficient RANSAC",
    "pyransac3d": "pyRANSAC-3D 0.7.0, repeated",
}
KEPT = ROOT / "out" / "peers"
LIMIT = 300  # s of one peer on one cloud
# A detection passes for a planned class within the larger of these of its radius; else it counts as no class's.
RELATIVE, ABSOLUTE = 0.15, 0.004
SOURCE = "other clouds of the same kind: 58 pipes, 5 M points, 3 mm noise; settings tuned on them by others"
QUOTED = (
    ("PCL, cylinder SAC repeated, 7 mm grid", 0.80, 0.80, 0.9, 315, "0/8 7/10 10/10 10/10 10/10 9/9"),
    ("Schnabel's Efficient RANSAC, 6 mm grid", 0.78, 0.80, 2.7, 5, "0/8 9/10 9/10 10/10 10/10 9/9"),
    ("CGAL Efficient RANSAC in C++, 6 mm grid", 0.71, 0.73, 3.9, 20, "0/8 8/10 9/10 9/10 9/10 9/9"),
    ("CylinderDetection (Araujo and Oliveira 2020), 6 mm grid", 0.69, 0.72, 2.5, 11, "0/8 8/10 8/10 10/10 8/10 7/9"),
)


def main() -> None:
    """Every detector on every cloud, then the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--noise-mm", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--layouts", nargs="+", choices=list(LAYOUTS), default=list(LAYOUTS))
    arguments = parser.parse_args()
    _environment()
    KEPT.mkdir(parents=True, exist_ok=True)
    clouds = [
        (layout, seed, noise)
        for layout in arguments.layouts
        for seed in arguments.seeds
        for noise in arguments.noise_mm
    ]
    rows: list[dict[str, Any]] = []
    for layout, seed, noise in clouds:
        rows += _compared(layout, seed, noise)
        content = {
            "title": "Detectors on the same scanned clouds, ours and peers",
            "command": " ".join(["python -m benchmarks.peers", *sys.argv[1:]]),
            "packages": PACKAGES,
            "rows": rows + [_quoted(*entry) for entry in QUOTED],
        }
        (RESULTS / "peers.json").write_text(json.dumps(content, indent=1) + "\n")


def _environment() -> None:
    """The peers' packages, installed once."""
    if not (ENVIRONMENT / "done").exists():
        venv.create(ENVIRONMENT, with_pip=True, clear=True)
        subprocess.run([ENVIRONMENT / "bin" / "python", "-m", "pip", "install", "--quiet", *PACKAGES], check=True)
        (ENVIRONMENT / "done").touch()


def _compared(layout: str, seed: int, noise: float) -> list[dict[str, Any]]:
    """A row for each detector on one cloud."""
    name = f"{layout}_{seed}_{noise:g}mm"
    build, count, distance = LAYOUTS[layout]
    site = build(np.random.default_rng(seed), 1.0, 0.0, distance)
    cloud, seen = taken(site, count, 1e-3 * noise, seed)
    rows = []
    for detector in ("ours", *PEERS):
        kept = KEPT / f"{name}_{detector}.json"
        if not kept.exists():
            print(f"{name}: {detector}", flush=True)
            if detector == "ours":
                figures = {**measured(site, cloud, seen, DetectConfig()), "commit": commit()}
            else:
                found, seconds = _peer(detector, cloud.points, name)
                classed = [_classed(Cylinder(*each), site.planned_radii) for each in found]
                figures = {"points": len(cloud.points), **judged(site, seen, classed), "seconds": seconds}
            kept.write_text(json.dumps(figures) + "\n")
        rows.append(_row(name, PEERS.get(detector, "ours"), json.loads(kept.read_text())))
        print(rows[-1], flush=True)
    return rows


def _peer(detector: str, points: Any, name: str) -> tuple[list[tuple[Any, Any, float]], float | None]:
    """The cylinders (start, end, radius) that a peer finds and its CPU seconds; none where it takes too long."""
    source, target = KEPT / f"{name}.npy", KEPT / f"{name}_{detector}.found"
    np.save(source, points.astype(np.float32))
    script = Path(__file__).with_name("peer_detectors.py")
    try:
        subprocess.run([ENVIRONMENT / "bin" / "python", script, detector, source, target], check=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return [], None
    finally:
        source.unlink()
    result = json.loads(target.read_text())
    found = [(np.array(each["start"]), np.array(each["end"]), each["radius"]) for each in result["cylinders"]]
    return found, result["seconds"]


def _classed(cylinder: Cylinder, radii: Any) -> Segment:
    """A detection with the nearest planned class, or none where its radius is far from all."""
    nearest = min(radii, key=lambda radius: abs(radius - cylinder.radius))
    fits = abs(nearest - cylinder.radius) <= max(RELATIVE * nearest, ABSOLUTE)
    return segment(cylinder, "", f"{1e3 * nearest:g}" if fits else None)


def _row(cloud: str, detector: str, figures: dict[str, Any]) -> dict[str, Any]:
    found, false, pipes = figures["found"], figures["false"], figures["pipes"]
    return {
        "cloud": cloud,
        "detector": detector,
        "found": f"{found} of {pipes}",
        "false": false,
        "F": round(2 * found / (found + false + pipes), 3),
        "right class": figures["right_class"],
        "radius RMSE [mm]": figures["radius_rmse_mm"],
        "CPU s": figures["seconds"],
        "found of each radius": " ".join(figures["found_of"].values()),
    }


def _quoted(detector: str, f_all: float, f_gated: float, radius: float, seconds: float, each: str) -> dict[str, Any]:
    return {
        "cloud": f"quoted: {SOURCE}",
        "detector": detector,
        "F": f_all,
        "F of planned classes": f_gated,
        "radius RMSE [mm]": radius,
        "CPU s": seconds,
        "found of each radius": each,
    }


if __name__ == "__main__":
    main()
