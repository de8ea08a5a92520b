# SPDX-License-Identifier: Apache-2.0
"""What the page's 3-D view shows: the cloud in nine bytes a point; pipes, cameras and boards as numbers."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from pipeprog_bringup.report.render import LIFT
from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_bringup.results.plan_file import read_plan
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map

MOST_POINTS = 400_000  # 3.6 MB, of the page's 15; the graphics of a phone draw as many without delay
MOST_CAMERAS = 2000  # pyramids; more are every n-th
STEPS = 65_535  # of a coordinate in 16 bits: 0.3 mm in a box of 20 m
CIRCLE_CORNERS = 12  # of a board's circle, which is a few pixels wide
PALE = 190  # grey of a cloud without colours


@dataclass(frozen=True)
class Thinned:
    """Points (N, 3) [m] and colours (N, 3) uint8 of a cloud, at most MOST_POINTS; the first `off_pipes` lie on none."""

    points: FloatArray
    colors: NDArray[np.uint8]
    off_pipes: int


def thinned(survey: Survey, margin: float) -> Thinned:
    """The cloud around the pipes with a margin [m], thinned evenly over the surfaces: one point a cell."""
    cloud = survey.results.cloud
    if cloud is None or not len(cloud.cloud.points):
        return Thinned(np.empty((0, 3)), np.empty((0, 3), np.uint8), 0)
    points = cloud.cloud.points
    low, high = np.percentile(points[:: 1 + len(points) // 100_000], (0.3, 99.7), axis=0)
    for cylinder in survey.cylinders:
        low = np.minimum(low, np.minimum(cylinder.start, cylinder.end) - margin)
        high = np.maximum(high, np.maximum(cylinder.start, cylinder.end) + margin)
    chosen = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    chosen = _one_a_cell(points, chosen)
    hiding = _on_pipes(points[chosen], survey.cylinders)
    chosen = np.concatenate([chosen[~hiding], chosen[hiding]])
    colors = np.full((len(chosen), 3), PALE, np.uint8) if cloud.colors is None else cloud.colors[chosen]
    return Thinned(points[chosen], colors, int((~hiding).sum()))


def cloud_bytes(cloud: Thinned) -> dict[str, Any]:
    """Corner and size [m] of the cloud's box, and base64 of its points, three uint16 each, and of its colours."""
    low = cloud.points.min(axis=0) if len(cloud.points) else np.zeros(3)
    size = np.maximum(np.ptp(cloud.points, axis=0), 1e-3) if len(cloud.points) else np.ones(3)
    steps = np.round((cloud.points - low) / size * STEPS).astype("<u2")
    return {
        "low": low.tolist(),
        "size": size.tolist(),
        "count": len(steps),
        "off_pipes": cloud.off_pipes,
        "points": base64.b64encode(steps.tobytes()).decode(),
        "colors": base64.b64encode(np.ascontiguousarray(cloud.colors).tobytes()).decode(),
    }


def view(survey: Survey, previous: Survey | None, letters: Sequence[str]) -> dict[str, Any]:
    """Pipes, cameras, boards, planned pipes that are not installed and pipes of the survey before, as plain values."""
    poses = survey.results.map_from_camera
    shown = poses[:: -(-len(poses) // MOST_CAMERAS)] if len(poses) else poses
    return {
        "pipes": _pipes(survey, letters),
        "cameras": np.round(shown[:, :3].reshape(-1, 12), 4).tolist(),
        "boards": _boards(survey),
        "planned": _planned(survey),
        "previous": [] if previous is None else _pipes(previous, [""] * len(previous.pipes)),
    }


def _pipes(survey: Survey, letters: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {
            "id": pipe["id"],
            "class": pipe["class"],
            "letter": own,
            "start": pipe["start"],
            "end": pipe["end"],
            "radius": pipe["radius"],
            "length": pipe["length"],
            "color": list(survey.color(pipe["class"])),
        }
        for pipe, own in zip(survey.pipes, letters, strict=True)
    ]


def _planned(survey: Survey) -> list[dict[str, Any]]:
    """Planned pipes with places of which most is not installed; none where the plan has no places."""
    path = survey.results.folder / "plan.json"
    states = {row["id"]: row["state"] for row in survey.results.planned}
    if not path.is_file():
        return []
    return [
        {
            "id": pipe.id,
            "start": pipe.cylinder.start.tolist(),
            "end": pipe.cylinder.end.tolist(),
            "radius": pipe.cylinder.radius,
            "color": list(survey.color(pipe.class_name)),
        }
        for pipe in read_plan(path)
        if states.get(pipe.id) not in (None, "installed")
    ]


def _boards(survey: Survey) -> list[dict[str, Any]]:
    """Boards where they hung, each a name and closed lines; none where the survey has left no map."""
    path = survey.results.folder / MAP_FILE
    if not path.is_file():
        return []
    return [
        {"name": board.name, "lines": [np.round(line, 4).tolist() for line in board_lines(board.circles)]}
        for board in read_map(path).boards
    ]


def board_lines(circles: FloatArray) -> list[FloatArray]:
    """Closed lines (M, 3) in a board's plane: the rectangle around its circles (N, 3), N > 2, and each circle [m].

    The map keeps no radii: the circles are drawn half as wide as the least distance between two.
    """
    middle = circles.mean(axis=0)
    plane = np.linalg.svd(circles - middle, full_matrices=False)[2][:2]
    corners = cv2.boxPoints(cv2.minAreaRect(((circles - middle) @ plane.T).astype(np.float32)))
    radius = 0.25 * float(pdist(circles).min())
    angles = np.linspace(0.0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles)]) @ plane
    outward = 2 * radius * np.sign(corners - corners.mean(axis=0))
    return [middle + (corners + outward) @ plane, *(circle + ring for circle in circles)]


def _one_a_cell(points: FloatArray, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of at most MOST_POINTS of the chosen points, one in each cell of a grid as fine as that allows."""
    if len(chosen) <= MOST_POINTS:
        return chosen
    # Surfaces have as many cells as the inverse square of their side: the side that is left after a first try.
    chosen = chosen[:: max(1, len(chosen) // (6 * MOST_POINTS))]
    low, side = points[chosen].min(axis=0), 0.01
    while True:
        cells = np.floor((points[chosen] - low) / side).astype(np.int64)
        key = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
        first = np.unique(key, return_index=True)[1]
        if len(first) <= MOST_POINTS:
            return chosen[np.sort(first)]
        side *= max(1.05, (len(first) / MOST_POINTS) ** 0.5)


def _on_pipes(points: FloatArray, cylinders: Sequence[Cylinder]) -> NDArray[np.bool_]:
    """Which points (N, 3) would hide the pipes: those on and in them."""
    on_pipe = np.zeros(len(points), bool)
    if not len(points) or not cylinders:
        return on_pipe
    tree = cKDTree(points)
    for cylinder in cylinders:
        reach = 0.5 * cylinder.length + cylinder.radius + LIFT
        near = np.array(tree.query_ball_point(cylinder.middle, reach), np.int64)
        along = cylinder.along(points[near])
        within = (along > -LIFT) & (along < cylinder.length + LIFT)
        on_pipe[near[within & (cylinder.surface_distance(points[near]) < LIFT)]] = True
    return on_pipe
