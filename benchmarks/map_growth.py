# SPDX-License-Identifier: Apache-2.0
"""Time per keyframe as the map grows: ten minutes of walking along a corridor and back, a keyframe a second.

    .venv/bin/python -m benchmarks.map_growth [MINUTES]

The keyframes are made of features alone (points of the walls with descriptors of their own, noise of 0.3 px), so that
what is timed is matching, registration, adjustment and bookkeeping; extraction and depth maps cost the same at any
size of the map. Prints the CPU time per keyframe around each minute, global adjustments included, and writes
results/map_growth.json beside this file.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.sift import Features, root_sift
from pipeprog_sfm.sparse.mapper import Mapper

RESULTS = Path(__file__).parent / "results" / "map_growth.json"
CAMERA = Camera(1280, 720, 900.0, 900.0, 639.5, 359.5)
STEP = 0.3  # m between keyframes, 2 m from the wall: a tenth of the image
DENSITY = 700  # points per metre of corridor, some 1500 in a view
NOISE = 0.3  # px
SECOND = 1_000_000_000  # ns
WINDOW = 30  # keyframes, of which the mean is told


def main(minutes: float) -> None:
    """Walk, and time each keyframe."""
    count = round(60 * minutes)
    length = STEP * count / 2
    points, looks = _corridor(length)
    mapper = Mapper(MapperConfig())
    spent = np.empty(count)
    truth = np.empty((count, 3))
    for number in range(count):
        x = STEP * min(number, count - number)
        pose = _pose(x, back=2 * number >= count)
        truth[number] = -pose[:3, :3].T @ pose[:3, 3]
        features = _view(points, looks, pose, number)
        started = time.process_time()
        mapper.add_features(number * SECOND, features, CAMERA)
        mapper.map.overlap_reports()
        mapper.map.camera_from_model()
        spent[number] = time.process_time() - started
    poses = mapper.map.camera_from_model()
    rows = []
    for minute in (minute for minute in (1.0, 3.0, 10.0) if minute <= minutes):
        near = spent[max(round(60 * minute) - WINDOW, 0) : round(60 * minute) + WINDOW]
        rows.append(
            {"minute": minute, "mean_ms": round(1e3 * near.mean(), 1), "median_ms": round(1e3 * np.median(near), 1)}
        )
    ratio = rows[-1]["mean_ms"] / rows[0]["mean_ms"]
    whole = np.cumsum(spent)
    ends = np.array([round(60 * row["minute"]) - 1 for row in rows])
    exponent = np.polyfit(np.log(ends + 1), np.log(whole[ends]), 1)[0] if len(rows) > 1 else np.nan
    facts = {
        "registered": len(poses),
        "keyframes": count,
        "models": len(mapper.map.models),
        "position_rmse_mm": round(
            1e3 * _rmse(np.array([_centre(pose) for pose in poses.values()]), truth[: len(poses)]), 2
        ),
        "exponent_of_the_whole": round(float(exponent), 2),
        "ratio_of_means": round(float(ratio), 2),
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    for row in rows:
        print(
            f"minute {row['minute']:4.0f}: mean {row['mean_ms']:7.1f} ms, median {row['median_ms']:7.1f} ms a keyframe"
        )
    print(facts)
    title = "CPU time per keyframe of the mapper as the map grows"
    command = f"python -m benchmarks.map_growth {minutes:g}"
    RESULTS.write_text(json.dumps({"title": title, "command": command, "rows": rows, **facts}, indent=1) + "\n")


def _corridor(length: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Points of a wall 2 m away with boxes before it and a floor, and their descriptors before normalisation."""
    rng = np.random.default_rng(7)
    count = round(DENSITY * (length + 4) / 3)
    x = rng.uniform(-2, length + 2, 3 * count)
    wall = np.c_[rng.uniform(-1.2, 1.2, count), np.full(count, 2.0)]
    floor = np.c_[np.full(count, 1.2), rng.uniform(0.8, 2.0, count)]
    boxes = np.c_[rng.uniform(-1, 1, count), rng.uniform(1.6, 2.0, count)]
    points = np.c_[x, np.concatenate([wall, floor, boxes])]
    order = np.argsort(x)
    return points[order], rng.gamma(0.7, 1.0, (len(points), 128)).astype(np.float32)


def _pose(x: float, back: bool) -> NDArray[np.float64]:
    """camera_from_world of a camera that looks at the wall, swaying; on the way back from a little farther away."""
    yaw = 0.1 * np.sin(4 * x)
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    pose[:3, 3] = -pose[:3, :3] @ [x + 0.13 * back, 0.05 * np.sin(3 * x), 0.1 * np.cos(2 * x) - 0.2 * back]
    return pose


def _view(points: NDArray[np.float64], looks: NDArray[np.float32], pose: NDArray[np.float64], seed: int) -> Features:
    rng = np.random.default_rng(seed)
    x = _centre(pose)[0]
    begin, end = np.searchsorted(points[:, 0], [x - 4, x + 4])
    inside = points[begin:end] @ pose[:3, :3].T + pose[:3, 3]
    pixels = inside[:, :2] / inside[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    seen = (inside[:, 2] > 0.2) & (pixels > 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
    index = rng.permutation(np.flatnonzero(seen & (rng.random(len(inside)) < 0.7)))
    keypoints = pixels[index] + rng.normal(0, NOISE, (len(index), 2))
    descriptors = looks[begin + index] * rng.lognormal(0, 0.15, (len(index), 128)).astype(np.float32)
    return Features(keypoints.astype(np.float32), root_sift(descriptors))


def _centre(camera_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def _rmse(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Root mean square distance in metres after the best similarity (Umeyama, PAMI 1991)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    return float(np.sqrt((((scale * a @ (u @ sign @ vt).T) - b) ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
