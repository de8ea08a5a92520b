# SPDX-License-Identifier: Apache-2.0
"""How far a survey's cloud lies from the true surfaces, and how much of the true pipes it covers.

    .venv/bin/python -m benchmarks.cloud_accuracy [demo] [lab:SEED] [field:SEED]

Writes results/cloud_accuracy.json. The truth is the NAME.surface.npz of the generator: points on all surfaces that the
camera saw, each with the pipe that it lies on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.recordings import Recording, named
from benchmarks.survey import RESULTS, RUNS, survey
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.scored_files import Truth, read_truth
from pipeprog_bringup.results.truth_alignment import aligned
from pipeprog_camera.arrays import FloatArray

SAMPLE = 200_000  # points of the cloud that are measured
NEIGHBOURS = 6  # surface points that tell the plane about a point of a wall
NEAR = 0.005  # m within which a point of the cloud covers a point of the true surface
CLOSE = 0.010  # m; the share of points within it is reported


def cloud_accuracy(recording: Recording, run: Path, count: int = SAMPLE) -> dict[str, Any]:
    """Distances of the cloud in `run` from the true surface, over at most `count` of its points, and coverage."""
    truth = read_truth(recording.beside("truth.json"))
    surface = np.load(recording.beside("surface.npz"))
    trajectory = aligned(run / "trajectory.tum", recording.beside("truth.json"))
    cloud = read_cloud(run / "cloud.ply").cloud
    points = cloud.points @ trajectory.world_from_map[:3, :3].T + trajectory.world_from_map[:3, 3]
    chosen = np.random.default_rng(0).permutation(len(points))[:count]
    distances = surface_distances(points[chosen], surface["points"].astype(float), surface["pipe"], truth)
    on_pipes = surface["points"][surface["pipe"] >= 0].astype(float)
    covered = np.isfinite(KDTree(points).query(on_pipes, distance_upper_bound=NEAR)[0])
    return {
        "points": len(points),
        "measured": len(chosen),
        "median [mm]": round(1e3 * float(np.median(distances)), 3),
        "RMS [mm]": round(1e3 * float(np.sqrt(np.mean(distances**2))), 3),
        f"within {1e3 * CLOSE:g} mm [%]": round(100 * float(np.mean(distances < CLOSE)), 2),
        f"pipe surface with a point within {1e3 * NEAR:g} mm [%]": round(100 * float(np.mean(covered)), 1),
    }


def surface_distances(points: FloatArray, surface: FloatArray, pipe: NDArray[np.int32], truth: Truth) -> FloatArray:
    """Distances (N,) [m] of points (N, 3): from the true cylinder where the nearest surface point (M, 3) is a pipe's.

    Elsewhere from the plane through the nearest surface points, whose spacing must not count as an error.
    """
    nearest = KDTree(surface).query(points, k=NEIGHBOURS)[1]
    patches = surface[nearest]
    middles = patches.mean(axis=1)
    normals = np.linalg.svd(patches - middles[:, None])[2][:, 2]
    distances = np.abs(np.einsum("ij,ij->i", points - middles, normals))
    for number, true_pipe in enumerate(truth.pipes):
        mine = pipe[nearest[:, 0]] == number
        axis = (true_pipe.end - true_pipe.start) / np.linalg.norm(true_pipe.end - true_pipe.start)
        from_axis = np.linalg.norm(np.cross(points[mine] - true_pipe.start, axis), axis=1)
        distances[mine] = np.abs(from_axis - true_pipe.radius)
    return distances


def main(names: list[str]) -> None:
    """Survey what has not been surveyed, then measure."""
    rows = []
    for name in names:
        recording = named(name)
        run = RUNS / recording.name
        if not (run / "cloud.ply").exists():
            survey(recording, results=RUNS)
        rows.append({"recording": recording.name, **cloud_accuracy(recording, run)})
        print(rows[-1], flush=True)
    content = {"title": "Clouds against the true surfaces", "rows": rows}
    (RESULTS / "cloud_accuracy.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:] or ["lab:11"])
