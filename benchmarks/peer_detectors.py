# SPDX-License-Identifier: Apache-2.0
"""Public detectors of cylinders on one cloud; run by benchmarks.peers in an environment of their own.

    python peer_detectors.py DETECTOR POINTS.npy OUT.json

Needs nothing of this project. OUT.json gets the cylinders (start, end, radius in metres) and the CPU seconds of the
detector alone. Each gets the cloud thinned to a grid of 6 mm, in which the published comparisons run them, and the same
settings on every cloud: of eight tried for CGAL on a lab those that found most.
"""

from __future__ import annotations

import json
import random
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

GRID = 0.006  # m
THINNEST, WIDEST = 0.005, 0.2  # m; wider and thinner cylinders are no pipe of any bill here
LENGTH_MIN = 0.1  # m
EPSILON = 0.004  # m from a surface, three times the noise of the cleaner clouds
FEWEST = 200  # points
SPACING = 0.05  # m between the points of one shape: a clamp does not part a pipe
NEIGHBOURS = 30  # that make a normal
LARGE = 10_000  # points of a plane that is taken off first, some 0.3 m^2

Points = Any
Cylinder = dict[str, Any]


def cgal(points: Points) -> list[Cylinder]:
    """Efficient RANSAC of CGAL: once the large planes are off, planes and cylinders compete for the points."""
    points, shapes, labels = _cgal(_without_planes(points), FEWEST, planes=True, cylinders=True)
    number = r"[-+0-9.e]+"
    found = []
    for index, text in enumerate(shapes):
        if "cylinder" not in text:
            continue
        centre, axis = (
            np.array([float(value) for value in re.findall(number, part)])
            for part in re.findall(r"\(([^)]*)\)", text)[:2]
        )
        radius = float(re.findall(rf"radius:({number})", text)[0])
        found.append(_cylinder(centre, axis, radius, points[labels == index]))
    return found


def pyransac3d(points: Points) -> list[Cylinder]:
    """RANSAC on three points, one cylinder after the other, once the large planes are off."""
    import pyransac3d as library

    random.seed(0)
    rest, found = _without_planes(points), []
    for _ in range(12):
        if len(rest) < FEWEST:
            break
        centre, axis, radius, inliers = library.Cylinder().fit(rest, EPSILON, 300)
        if len(inliers) < FEWEST:
            break
        found.append(_cylinder(np.asarray(centre), np.asarray(axis), float(radius), rest[inliers]))
        rest = np.delete(rest, inliers, axis=0)
    return found


DETECTORS: dict[str, Callable[[Points], list[Cylinder]]] = {"cgal": cgal, "pyransac3d": pyransac3d}


def main(name: str, source: Path, target: Path) -> None:
    """Detect, and write the result."""
    cloud = np.load(source).astype(float)
    points = cloud[np.unique(np.floor(cloud / GRID).astype(np.int64), axis=0, return_index=True)[1]]
    started = time.process_time()
    found = DETECTORS[name](points)
    seconds = time.process_time() - started
    kept = [
        each
        for each in found
        if THINNEST < each["radius"] < WIDEST
        and np.linalg.norm(np.subtract(each["end"], each["start"])) > max(LENGTH_MIN, 3 * each["radius"])
    ]
    target.write_text(json.dumps({"cylinders": kept, "seconds": round(seconds, 1), "points": len(points)}) + "\n")


def _cgal(points: Points, fewest: int, planes: bool, cylinders: bool) -> tuple[Points, list[str], Any]:
    """CGAL's Efficient RANSAC: the points, which it sorts anew, each shape in its words, each point's shape or -1."""
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3
    from CGAL.CGAL_Point_set_processing_3 import pca_estimate_normals
    from CGAL.CGAL_Shape_detection import efficient_RANSAC

    cloud = Point_set_3()
    cloud.reserve(len(points))
    for x, y, z in points.tolist():
        cloud.insert(Point_3(x, y, z))
    pca_estimate_normals(cloud, NEIGHBOURS)
    shape = cloud.add_int_map("shape", -1)
    # Order: fewest points, distance, spacing of a shape's points, normals' cosine, chance to miss a larger shape.
    texts = efficient_RANSAC(cloud, shape, fewest, EPSILON, SPACING, 0.8, 1e-4, planes, False, cylinders, False, False)
    labels = np.fromiter((shape.get(index) for index in cloud.indices()), np.int64, len(points))
    moved = np.array([(point.x(), point.y(), point.z()) for point in cloud.points()])
    return moved, list(texts), labels


def _without_planes(points: Points) -> Points:
    """The points that lie on no large plane."""
    points, _, labels = _cgal(points, LARGE, planes=True, cylinders=False)
    return points[labels < 0]


def _cylinder(centre: Any, axis: Any, radius: float, points: Points) -> Cylinder:
    """The cylinder from where its points begin to where they end, a hundredth of them left out at each end."""
    axis = axis / np.linalg.norm(axis)
    low, high = np.quantile((points - centre) @ axis, [0.01, 0.99])
    return {"start": (centre + low * axis).tolist(), "end": (centre + high * axis).tolist(), "radius": radius}


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
