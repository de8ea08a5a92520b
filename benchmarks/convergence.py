# SPDX-License-Identifier: Apache-2.0
"""How far off a start may be: the cloud's fit and the refinement by outlines, from many wrong starts each.

    .venv/bin/python -m benchmarks.convergence cloud [--trials 10]
    .venv/bin/python -m benchmarks.convergence contour [demo | BAG ...] [--starts 20] [--views 24]

`cloud`: a pipe before a wall, scanned at each radius, arc and noise; its axis is turned by 10 degrees and its radius a
fifth off. A trial has converged where it ends as the fit from the true cylinder does; pipes which even that does not
fit (thin ones in strong noise, which the detector seeks at planned radii) have no trials.
`contour`: the true poses of a recording with a truth file; the ends of each pipe are a fifth of the radius aside and
its radius a tenth off, either way. The error is that against the truth, so every start that went astray shows.
Writes results/convergence_cloud.json or results/convergence_contour.json.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from rclpy.serialization import deserialize_message
from rich.progress import track
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import ROOT, Recording, made, named
from benchmarks.survey import RESULTS
from pipeprog_bringup.recording.bag import Bag
from pipeprog_detect.cloud import local_shape, octree, plane_segmentation
from pipeprog_detect.cloud.axis_voting import Hypothesis
from pipeprog_detect.cloud.candidate import Candidate, fit_candidate
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.types import Cylinder, View

sys.path.insert(0, str(ROOT / "bags"))
from pipeprog_camera.arrays import FloatArray
from sitegen.primitives import cylinder, rectangle
from sitegen.scan import scan
from sitegen.site import CONCRETE, PIPE_MATERIALS

RADII = (0.0086, 0.0365, 0.0575, 0.0841, 0.1095, 0.1223)
ARCS_DEG = (90, 120, 150)
NOISES_MM = (1.0, 2.0, 3.0)
LENGTH, WALL = 1.5, 0.03  # m; the pipe's, and what is free between it and the wall
AXIS_OFF, RADIUS_OFF = np.radians(10.0), 0.2
SAME_AXIS, SAME_RADIUS = np.radians(0.5), 2e-4  # where two fits are one; radius also within its sigma
RADIUS_OFF_IMAGE, ENDS_OFF_IMAGE = 0.1, 0.2


def cloud(trials: int) -> None:
    """Trials at every radius, arc and noise."""
    rows: list[dict[str, Any]] = []
    cases = [(radius, arc, noise) for radius in RADII for arc in ARCS_DEG for noise in NOISES_MM]
    for radius, arc, noise in track(cases, "cloud fits"):
        rng = np.random.default_rng([round(1e4 * radius), arc, round(noise)])
        points, truth = scanned(radius, np.radians(arc), 1e-3 * noise, rng)
        tree = octree.build(points)
        sigma = local_shape.estimate_noise(tree)
        # As in the detector, which fits what is left beside large planes.
        tree = tree.subset(~plane_segmentation.find_planes(tree, sigma, 1.5 * max(RADII))[1])
        free = np.ones(len(tree.points), bool)
        middle = truth.middle
        half = max(2.0 * radius, 0.05)
        direct = fit_candidate(
            tree, free, Hypothesis(Cylinder(middle - half * truth.axis, middle + half * truth.axis, radius), 0), sigma
        )
        ends = [
            fit_candidate(tree, free, Hypothesis(turned(middle, truth, half, rng), 0), sigma) for _ in range(trials)
        ]
        rows.append(
            {
                "radius mm": 1e3 * radius,
                "arc deg": arc,
                "noise mm": noise,
                "trials": trials,
                "converged": None if direct is None else sum(same(end, direct) for end in ends),
                "radius error from the true start mm": None
                if direct is None
                else round(1e3 * (direct.cylinder.radius - radius), 3),
                "stated sigma mm": None if direct is None else round(1e3 * direct.radius_sigma, 3),
            }
        )
    fitted = [row for row in rows if row["converged"] is not None]
    total, done = trials * len(fitted), sum(row["converged"] for row in fitted)
    print(f"converged: {done} of {total} ({100 * done / total:.1f} %)")
    for radius in RADII:
        print(f"{1e3 * radius:8g} mm:", [row["converged"] for row in rows if row["radius mm"] == 1e3 * radius])
    write(
        "convergence_cloud",
        f"Cloud fit from an axis 10 deg and a radius 20 % off: {done} of {total} converge, "
        f"{len(rows) - len(fitted)} of {len(rows)} pipes cannot be fitted from the truth either",
        "python -m benchmarks.convergence cloud",
        rows,
    )


def scanned(radius: float, arc: float, noise: float, rng: np.random.Generator) -> tuple[FloatArray, Cylinder]:
    """Points (N, 3) of a wall and of an arc of an upright pipe before it, about 60,000, and the pipe."""
    away = radius + WALL
    truth = Cylinder(np.array([0.0, -away, 0.0]), np.array([0.1, -away, LENGTH]), radius)
    parts = [
        rectangle([0.0, 0.0, 0.75], [0, -1, 0], 1.6, 1.8, CONCRETE),
        cylinder(truth.start, truth.end, radius, PIPE_MATERIALS[0]),
    ]
    aims = np.concatenate(
        [
            rng.uniform([-0.8, 0.0, 0.0], [0.8, 0.0, LENGTH], (20_000, 3)),
            rng.uniform([-radius, -away, 0.0], [radius + 0.1, -away, LENGTH], (20_000, 3)),
        ]
    )
    points, _, owner = scan(parts, [[-0.5, -2.0, 1.0], [0.6, -2.0, 0.6]], aims, noise, rng)
    u, v = basis(truth.axis)
    offset = points - truth.start
    front = np.array([0.0, -1.0, 0.0])
    lateral = np.stack([offset @ u, offset @ v], axis=1)
    facing = lateral @ np.array([front @ u, front @ v]) > np.cos(0.5 * arc) * np.linalg.norm(lateral, axis=1)
    return points[(owner == 0) | facing], truth


def turned(middle: FloatArray, truth: Cylinder, half: float, rng: np.random.Generator) -> Cylinder:
    """A stretch of the pipe with its axis turned about its middle and its radius off, either way."""
    u, v = basis(truth.axis)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.cos(AXIS_OFF) * truth.axis + np.sin(AXIS_OFF) * (np.cos(angle) * u + np.sin(angle) * v)
    radius = truth.radius * (1.0 + rng.choice([-RADIUS_OFF, RADIUS_OFF]))
    return Cylinder(middle - half * axis, middle + half * axis, radius)


def same(one: Candidate | None, other: Candidate | None) -> bool:
    """Whether two fits are one."""
    if one is None or other is None:
        return False
    along = abs(float(one.cylinder.axis @ other.cylinder.axis))
    near = abs(one.cylinder.radius - other.cylinder.radius) < max(SAME_RADIUS, other.radius_sigma)
    return bool(near and along > np.cos(SAME_AXIS))


def contour(recordings: Sequence[Recording], starts: int, most_views: int) -> None:
    """Starts for every pipe of every recording."""
    rows: list[dict[str, Any]] = []
    for recording in recordings:
        truth = json.loads(made(recording).beside("truth.json").read_text())
        views = true_views(recording, truth, most_views)
        pipes = [Cylinder(np.array(pipe["start"]), np.array(pipe["end"]), pipe["radius"]) for pipe in truth["pipes"]]
        for number, pipe in enumerate(pipes):
            rng = np.random.default_rng(number)
            others = pipes[:number] + pipes[number + 1 :]
            errors, sigmas = [], []
            for _ in track(range(starts), f"{recording.name}, pipe {number}"):
                fit = refine(Start(disturbed(pipe, rng), RADIUS_OFF_IMAGE * pipe.radius), views, others)
                if fit is not None:
                    errors.append(1e3 * (fit.cylinder.radius - pipe.radius))
                    sigmas.append(1e3 * fit.radius_sigma)
            off = np.abs(errors) if errors else np.array([np.nan])
            rows.append(
                {
                    "recording": recording.name,
                    "pipe": number,
                    "radius mm": round(1e3 * pipe.radius, 2),
                    "starts": starts,
                    "refined": len(errors),
                    "rmse mm": round(float(np.sqrt(np.mean(off**2))), 3),
                    "worst mm": round(float(off.max()), 3),
                    "beyond 1 mm": int((off > 1.0).sum()),
                    "beyond 3 sigma": int((off > 3.0 * np.array(sigmas or [np.nan])).sum()),
                }
            )
            print(rows[-1], flush=True)
    total = float(np.sqrt(np.nanmean([row["rmse mm"] ** 2 for row in rows])))
    print(f"RMSE over the pipes: {total:.3f} mm")
    write(
        "convergence_contour",
        f"Outlines at true poses from ends 20 % and radii 10 % of R off: {total:.3f} mm RMSE",
        f"python -m benchmarks.convergence contour {' '.join(recording.name for recording in recordings)}",
        rows,
    )


def true_views(recording: Recording, truth: dict[str, Any], most: int) -> list[View]:
    """At most `most` frames, evenly over the recording, with their true poses."""
    bag = Bag.open(recording.bag)
    poses = np.array(truth["camera_to_world"])
    wanted = set(np.linspace(0, len(poses) - 1, min(most, len(poses))).astype(int).tolist())
    views = []
    for number, frame in enumerate(bag):
        if number in wanted:
            encoded = np.frombuffer(deserialize_message(frame.data, CompressedImage).data, np.uint8)
            image = bag.camera.undistort_image(np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), np.uint8))
            views.append(View(frame.stamp, image, bag.camera.pinhole(), np.linalg.inv(poses[number])))
    return views


def disturbed(pipe: Cylinder, rng: np.random.Generator) -> Cylinder:
    """Both ends a fifth of the radius aside, the radius a tenth off."""
    u, v = basis(pipe.axis)
    angle = rng.uniform(0.0, 2.0 * np.pi, 2)
    aside = ENDS_OFF_IMAGE * pipe.radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
    radius = pipe.radius * (1.0 + rng.choice([-RADIUS_OFF_IMAGE, RADIUS_OFF_IMAGE]))
    return Cylinder(pipe.start + aside[0], pipe.end + aside[1], radius)


def write(name: str, title: str, command: str, rows: list[dict[str, Any]]) -> None:
    """Leave the rows in results/."""
    result = {"title": title, "command": command, "rows": rows}
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("cloud", "contour"))
    parser.add_argument("recordings", nargs="*", default=["demo"])
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--views", type=int, default=24)
    arguments = parser.parse_args()
    if arguments.what == "cloud":
        cloud(arguments.trials)
    else:
        contour([named(text) for text in arguments.recordings], arguments.starts, arguments.views)
