# SPDX-License-Identifier: Apache-2.0
"""The pictures of docs/method.md, one a stage, from the results of the demo.

    make demo
    .venv/bin/python -m benchmarks.method_pictures [DIR]

DIR holds the results of the demo (out/demo without it). Each picture shows what the stage's own code makes of them;
the pictures are written to docs/images/method_*.png.
"""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from numpy.typing import NDArray
from PIL import Image
from rclpy.serialization import deserialize_message
from scipy.spatial import ConvexHull
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import DEMO, ROOT
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_camera.camera import Camera
from pipeprog_detect.cloud import axis_voting, local_shape, octree, plane_segmentation
from pipeprog_detect.cloud.cylinder_fit import basis, fit_cylinder
from pipeprog_detect.cloud.ellipse_search import find_ellipses
from pipeprog_detect.silhouette.apparent_contour import contour_samples, project
from pipeprog_detect.silhouette.light_sampling import LINEAR_LIGHT
from pipeprog_detect.silhouette.limb_edges import limb_basis
from pipeprog_detect.thin.line_segments import segment_pairs, straight_edges
from pipeprog_detect.types import Cylinder, View
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.config import BoardConfig, MapperConfig, StereoConfig
from pipeprog_sfm.dense.stereo import Picture, StereoImage, choose_pairs, depth_map
from pipeprog_sfm.features.sift import extract

FloatArray = NDArray[np.float64]
IMAGES = ROOT / "docs" / "images"
WIDTH = 720  # px of each picture
DPI = 100
COLORS = 256  # of the palette: photographs stay below 150 kB
GREY, BLUE, ORANGE, GREEN, RED = "#9aa3ad", "#1668b8", "#e07b00", "#1a8f4c", "#c62828"
# Pipes of the demo that show a stage well.
STANDING, THIN, LYING = "p01", "p02", "p05"


@dataclass(frozen=True)
class Survey:
    """Results of the demo."""

    folder: Path

    @cached_property
    def camera(self) -> Camera:
        """Of the keyframes, which have no distortion."""
        return Bag.open(self.folder / "out.mcap").camera

    @cached_property
    def images(self) -> list[NDArray[np.uint8]]:
        """The keyframes (H, W, 3) BGR, in order of time."""
        encoded = (deserialize_message(each.data, CompressedImage).data for each in Bag.open(self.folder / "out.mcap"))
        decoded = (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in encoded)
        return [np.asarray(image, np.uint8) for image in decoded]

    @cached_property
    def poses(self) -> FloatArray:
        """map_from_camera (N, 4, 4) of the keyframes."""
        return read_trajectory(self.folder / "trajectory.tum")[1]

    @cached_property
    def points(self) -> FloatArray:
        """The dense cloud (N, 3) [m]."""
        return read_cloud(self.folder / "cloud.ply").cloud.points

    @cached_property
    def result(self) -> dict[str, Any]:
        """pipes.json."""
        content: dict[str, Any] = json.loads((self.folder / "pipes.json").read_text())
        return content

    @cached_property
    def sparse(self) -> tuple[dict[int, FloatArray], list[tuple[FloatArray, NDArray[np.int64]]]]:
        """Points (3,) of the sparse model by number; for each keyframe its tie points' pixels (M, 2) and numbers."""
        text = [line.split() for line in (self.folder / "colmap" / "points3D.txt").read_text().splitlines()]
        points = {int(words[0]): np.array(words[1:4], float) for words in text if words[0] != "#"}
        lines = (self.folder / "colmap" / "images.txt").read_text().splitlines()
        kept = [line for line in lines if not line.startswith("#")]
        rows = [np.array(line.split(), float).reshape(-1, 3) for line in kept[1::2]]
        return points, [(row[row[:, 2] >= 0, :2] - 0.5, row[row[:, 2] >= 0, 2].astype(int)) for row in rows]

    def pipe(self, name: str) -> Cylinder:
        """A pipe by its id."""
        entry = next(entry for entry in self.result["pipes"] if entry["id"] == name)
        return Cylinder(np.array(entry["start"]), np.array(entry["end"]), entry["radius"])

    def view(self, number: int) -> View:
        """A keyframe as the detector has it."""
        gray = cv2.cvtColor(self.images[number], cv2.COLOR_BGR2GRAY)
        return View(number, np.asarray(gray, np.uint8), self.camera, np.linalg.inv(self.poses[number]))

    def best_view(self, point: FloatArray) -> int:
        """The keyframe in which a point (3,) is nearest to the centre of the image."""
        middle = np.array([self.camera.width, self.camera.height]) / 2
        far = [np.linalg.norm(project(self.view(k), point[None])[0][0] - middle) for k in range(len(self.images))]
        return int(np.argmin(far))


def frames(survey: Survey, figure: Figure) -> None:
    """Eq. 1 on one keyframe, and the predicted overlap over the frames."""
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    with (survey.folder / "frames.csv").open() as stream:
        every = list(csv.DictReader(stream))
    keyframes = [float(row["overlap_n"]) for row in every if row["overlap_n"]]
    number = int(np.argmin(keyframes))
    pixels, _ = survey.sparse[1][number]
    features = extract(survey.view(number).image, survey.camera, MapperConfig()).keypoints
    _photo(left, survey.images[number])
    left.plot(*features.T, ".", ms=1, color="white")
    left.plot(*pixels.T, ".", ms=1, color=ORANGE)
    areas = []
    for points, color in ((features, "white"), (pixels, ORANGE)):
        hull = ConvexHull(points)
        areas.append(hull.volume)
        left.fill(*points[hull.vertices].T, fill=False, ec=color, lw=1.5)
    left.set_title(f"hulls of tie points (orange), features (white): Ov = {areas[1] / areas[0]:.3f}")
    rows = [row for row in every if row["overlap_predicted"]]
    first = int(rows[0]["stamp"])
    seconds = np.array([(int(row["stamp"]) - first) * 1e-9 for row in rows])
    overlap = np.array([float(row["overlap_predicted"]) for row in rows])
    chosen = np.array([row["chosen"] == "1" for row in rows])
    right.plot(seconds[chosen], overlap[chosen], "o", color=BLUE, ms=4, label="keyframe")
    right.plot(seconds[~chosen], overlap[~chosen], "o", mfc="white", mec=GREY, ms=4, label="not chosen")
    right.axhline(0.85, color=RED, lw=1, label="Ov_min")
    right.set(xlabel="time [s]", title="predicted overlap with the last keyframe")
    right.legend()


def matches(survey: Survey, figure: Figure) -> None:
    """Tie points that two keyframes share."""
    one, other = 10, 14
    axes = figure.subplots()
    small = [cv2.resize(survey.images[k], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for k in (one, other)]
    _photo(axes, np.hstack(small))
    (first, own), (second, others) = survey.sparse[1][one], survey.sparse[1][other]
    shared, at, in_other = np.intersect1d(own, others, return_indices=True)
    offset = np.array([small[0].shape[1], 0])
    for k in np.random.default_rng(0).choice(len(shared), 60, replace=False):
        ends = np.stack([first[at[k]] / 2, second[in_other[k]] / 2 + offset])
        axes.plot(*ends.T, "-", color=BLUE, lw=0.6, marker=".", ms=2)
    axes.set_title(f"{len(shared)} tie points in both keyframes, 60 shown")


def poses(survey: Survey, figure: Figure) -> None:
    """The sparse model and the cameras from above."""
    axes = figure.subplots()
    points = np.array(list(survey.sparse[0].values()))
    axes.plot(points[:, 0], points[:, 1], ",", color=GREY)
    centres, forward = survey.poses[:, :3, 3], survey.poses[:, :3, 2]
    axes.plot(centres[:, 0], centres[:, 1], "-o", color=BLUE, ms=3, lw=1, label="keyframes, and where they look")
    axes.quiver(*centres[:, :2].T, *forward[:, :2].T, color=BLUE, width=0.002, scale=25)
    for entry in survey.result["pipes"]:
        axes.plot(*np.array([entry["start"], entry["end"]]).T[:2], "-", color=RED, lw=2)
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(centres[:, 1].min() - 0.3, 0.3), aspect="equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="sparse points (grey), pipes (red), from above")
    axes.legend(loc="lower right")


def board(survey: Survey, figure: Figure) -> None:
    """The circles of the board, and how far the centre of an ellipse is from the circle's."""
    targets = load_board_file(DEMO.beside("board.yaml"))
    seen = []
    for number in range(len(survey.images)):
        ellipses = detect_ellipses(survey.view(number).image, survey.camera, BoardConfig())
        for found in detect_boards(ellipses, targets.boards, survey.camera):
            if len(found.indices) == 5:
                seen.append((float(np.linalg.norm(found.centres - found.ellipse_centres, axis=1).max()), number, found))
    _, number, best = max(seen, key=lambda entry: entry[0])
    whole, detail = figure.subplots(1, 2)
    low, high = best.centres.min(axis=0) - 70, best.centres.max(axis=0) + 70
    for axes in (whole, detail):
        _photo(axes, survey.images[number])
        for conic in best.conics:
            _draw_conic(axes, conic)
        axes.plot(*best.ellipse_centres.T, "x", color=ORANGE, ms=7, label="centre of the ellipse")
        axes.plot(*best.centres.T, "+", color=BLUE, ms=9, label="image of the circle's centre")
    for index, centre in zip(best.indices, best.centres, strict=True):
        whole.annotate(f"{index + 1}", centre + np.array([14, -14]), color=RED, fontsize=11, weight="bold")
    whole.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), title="circles found and told apart")
    worst = int(np.linalg.norm(best.centres - best.ellipse_centres, axis=1).argmax())
    middle = best.centres[worst]
    detail.set(xlim=(middle[0] - 0.3, middle[0] + 0.3), ylim=(middle[1] + 0.2, middle[1] - 0.2))
    detail.set(xticks=np.round(middle[0] + np.arange(-2, 3) / 10, 1), xlabel="column [px]")
    shift = np.linalg.norm(best.centres[worst] - best.ellipse_centres[worst])
    detail.set_title(f"circle {best.indices[worst] + 1}, centre: {shift:.2f} px apart")
    detail.legend(loc="lower right")


def depth(survey: Survey, figure: Figure) -> None:
    """A keyframe and its depth map."""
    number = 18
    view_from_map = np.linalg.inv(survey.poses)
    everyone = {k: view_from_map[k] for k in range(len(survey.poses))}
    images = {k: StereoImage(k, Picture(survey.images[k], survey.camera), everyone[k]) for k in everyone}
    neighbours = choose_pairs(number, everyone, 2.0, StereoConfig())
    found = depth_map(images[number], [images[k] for k in neighbours], (0.8, 5.0))
    left, right = figure.subplots(1, 2)
    _photo(left, survey.images[number])
    left.set_title("keyframe")
    shown = right.imshow(found.depth, cmap="viridis", vmin=1.5, vmax=2.6)
    right.set(xticks=[], yticks=[], title=f"depth [m], from {len(neighbours)} neighbours")
    figure.colorbar(shown, ax=right, fraction=0.03)


def planes(survey: Survey, figure: Figure) -> None:
    """The cloud, what lies on large planes, and what is left."""
    tree = octree.build(survey.points)
    sigma = local_shape.estimate_noise(tree)
    found, on_plane = plane_segmentation.find_planes(tree, sigma, 0.16)
    left, right = figure.subplots(1, 2, sharey=True)
    some = np.random.default_rng(0).choice(len(tree.points), 120_000, replace=False)
    for axes, mask, title in (
        (left, on_plane, f"on one of {len(found)} planes"),
        (right, ~on_plane, "left for the search"),
    ):
        points = tree.points[some[mask[some]]]
        points = points[np.argsort(-points[:, 1])]
        axes.scatter(points[:, 0], points[:, 2], s=0.1, c=points[:, 1], cmap="cividis", vmin=-0.6, vmax=0.1)
        axes.set(aspect="equal", title=title, xlabel="x [m]", xlim=(-2.6, 2.0), ylim=(-2.2, 0.6))
    left.set_ylabel("z [m]")


def votes(survey: Survey, figure: Figure) -> None:
    """Votes of curved patches for an axis (left), and Algorithm 3 of the paper (right)."""
    pipe = survey.pipe(LYING)
    near = survey.points[np.linalg.norm(pipe.from_axis(survey.points), axis=1) < 3 * pipe.radius]
    near = near[(pipe.along(near) > 0) & (pipe.along(near) < pipe.length)]
    tree = octree.build(near)
    sigma = local_shape.estimate_noise(tree)
    scale = 0.056
    shape = local_shape.surfaces(
        tree.thinned(tree.level_of(scale / 7)), tree.thinned(tree.level_of(scale)), scale, sigma
    )
    vote = axis_voting.patch_votes(shape, sigma, (0.005, 0.16))
    left, right = figure.subplots(1, 2)
    middle = pipe.middle
    u, v = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    slab = near[np.abs(pipe.along(near) - 0.5 * pipe.length) < 0.02] - middle
    left.plot(slab @ u, slab @ v, ",", color=GREY)
    feet, centres = vote.feet - middle, vote.points - middle
    for k in range(0, len(feet), 3):
        left.plot(*np.stack([[feet[k] @ u, centres[k] @ u], [feet[k] @ v, centres[k] @ v]]), "-", color=BLUE, lw=0.4)
    left.plot(centres @ u, centres @ v, ".", color=ORANGE, ms=4, label=f"{len(centres)} votes for the axis")
    left.add_patch(Circle((0, 0), pipe.radius, fill=False, ec=RED, lw=1))
    left.set(aspect="equal", title="votes: along the normal, by 1 / curvature", xlabel="y [m]", ylabel="z [m]")
    left.set(xlim=(-0.18, 0.18), ylim=(-0.12, 0.14))
    left.legend()
    _section(right, survey.pipe(STANDING), survey.points)


def _section(axes: Axes, pipe: Cylinder, points: FloatArray) -> None:
    """Where a plane at 35 degrees cuts a pipe: the ellipse that is found, and its axis by Eq. 3."""
    tilt = np.radians(35.0)
    normal = np.cos(tilt) * pipe.axis + np.sin(tilt) * basis(pipe.axis)[0]
    u, v = basis(normal)
    offset = points - pipe.middle
    slab = offset[(np.abs(offset @ normal) < 0.01) & (np.linalg.norm(offset, axis=1) < 0.25)]
    flat = np.stack([slab @ u, slab @ v], axis=1)
    axes.plot(*flat.T, ",", color=GREY)
    for found in find_ellipses(flat, 1e-3, (0.04, 0.08), np.random.default_rng(0)):
        size = 2 * found.major, 2 * found.minor
        axes.add_patch(Ellipse(tuple(found.centre), *size, angle=np.degrees(found.angle), fill=False, ec=RED, lw=1))
        axes.plot(*flat[found.inliers].T, ",", color=BLUE)
        turned = np.degrees(np.arccos(found.minor / found.major))
        axes.set_title(f"section: b = {1e3 * found.minor:.1f} mm, acos(b/a) = {turned:.0f}°")
    axes.set(aspect="equal", xlabel="in the plane [m]", xlim=(-0.15, 0.15), ylim=(-0.12, 0.1))


def fit(survey: Survey, figure: Figure) -> None:
    """The cylinder fit beside a wall: which points count."""
    pipe = survey.pipe(LYING)
    near = survey.points[np.linalg.norm(pipe.from_axis(survey.points), axis=1) < 2.2 * pipe.radius]
    near = near[(pipe.along(near) > 0.25) & (pipe.along(near) < 0.9)][::5]
    start = replace(pipe.shifted(np.array([0.0, 0.006, 0.004])), radius=1.1 * pipe.radius)
    found = fit_cylinder(near, start, 1.2e-3)
    assert found is not None
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.2))
    u, v = basis(found.cylinder.axis)
    across = near - found.cylinder.middle
    for mask, color, name in ((~found.inliers, GREY, "no weight"), (found.inliers, BLUE, "inliers")):
        left.plot(across[mask] @ u, across[mask] @ v, ",", color=color)
        left.plot([], [], "o", ms=4, color=color, label=name)
    off = start.middle - found.cylinder.middle
    left.add_patch(Circle((off @ u, off @ v), start.radius, fill=False, ec=ORANGE, lw=1, ls="--", label="start"))
    left.add_patch(Circle((0, 0), found.cylinder.radius, fill=False, ec=RED, lw=1, label="fit"))
    left.set(aspect="equal", xlabel="[m]", ylabel="[m]", title="seen along the axis, with the wall")
    left.legend(loc="center")
    distance = 1e3 * found.cylinder.surface_distance(near)
    bins = np.arange(-15, 30, 0.5)
    right.hist(distance[~found.inliers], bins, color=GREY)
    right.hist(distance[found.inliers], bins, color=BLUE)
    sigma = 1e3 * found.radius_sigma
    right.set(xlabel="distance from the surface [mm]", ylabel="points", yscale="log")
    right.set_title(f"r = {1e3 * found.cylinder.radius:.2f} ± {sigma:.2f} mm")


def contour(survey: Survey, figure: Figure) -> None:
    """The apparent contour of a pipe, and the limb edge on one side of it."""
    pipe = survey.pipe(LYING)
    number = survey.best_view(pipe.middle)
    view = survey.view(number)
    sides, width = _contour_lines(pipe, view)
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    _photo(left, survey.images[number])
    for line in sides:
        left.plot(*line.T, "-", color=RED, lw=1)
    middle = sides.mean(axis=(0, 1))
    left.set(xlim=(middle[0] - 260, middle[0] + 260), ylim=(middle[1] + 200, middle[1] - 200))
    left.set_title("apparent contour: two lines, from the cylinder")
    line = sides[0]
    tangent = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    outward = np.array([-tangent[1], tangent[0]])
    outward *= np.sign(outward @ (line.mean(axis=0) - middle))
    offsets = np.arange(-7.0, 6.0, 0.5)
    feet = line.mean(axis=0) + np.arange(-25, 26)[:, None] * tangent
    at = (feet[:, None] + offsets[:, None] * outward).astype(np.float32)
    light = cv2.remap(cv2.LUT(view.image, LINEAR_LIGHT), at[..., 0], at[..., 1], cv2.INTER_CUBIC).mean(axis=0)
    left.plot(*(line.mean(axis=0) + np.outer([-25, 25], tangent)).T, "-", color=ORANGE, lw=3)
    trials = np.arange(-2, 2, 0.05)
    fits = [np.linalg.lstsq(limb_basis(offsets - t, width / 2, 0.6), light, rcond=None) for t in trials]
    best = int(np.argmin([float(each[1][0]) for each in fits]))
    fine = np.arange(-7, 5.5, 0.05)
    right.plot(offsets, light, "o", ms=4, color=GREY, label="light, mean of 51 rows (orange, left)")
    right.plot(fine, limb_basis(fine - trials[best], width / 2, 0.6) @ fits[best][0], color=BLUE, label="limb model")
    right.axvline(trials[best], color=BLUE, lw=1, ls="--", label=f"limb edge at {trials[best]:+.2f} px")
    right.axvline(0, color=RED, lw=1, label="apparent contour")
    right.set(xlabel="outwards [px]", ylabel="light", title="a profile across the contour")
    right.legend()


def ends(survey: Survey, figure: Figure) -> None:
    """The end rims of a pipe."""
    pipe = survey.pipe(LYING)
    for axes, end, title in zip(figure.subplots(1, 2), (pipe.start, pipe.end), ("start", "end"), strict=True):
        number = survey.best_view(end)
        view = survey.view(number)
        _photo(axes, survey.images[number])
        u, v = basis(pipe.axis)
        turns = np.linspace(0, 2 * np.pi, 90)[:, None]
        for offset, color in ((0.0, RED), (-0.02, ORANGE), (0.02, ORANGE)):
            place = end + offset * pipe.axis
            circle = place + pipe.radius * (np.cos(turns) * u + np.sin(turns) * v)
            axes.plot(*project(view, circle)[0].T, color=color, lw=1.2 if color == RED else 0.6)
        for line in _contour_lines(pipe, view)[0]:
            axes.plot(*line.T, "-", color=RED, lw=0.8)
        middle = project(view, end[None])[0][0]
        axes.set(xlim=(middle[0] - 130, middle[0] + 130), ylim=(middle[1] + 100, middle[1] - 100))
        axes.set_title(f"{title}: end rim (red), 20 mm either way (orange)")


def thin(survey: Survey, figure: Figure) -> None:
    """Segment pairs in two keyframes, and the thin pipe that they agree on."""
    pipe = survey.pipe(THIN)
    first = survey.best_view(pipe.middle)
    for axes, number in zip(figure.subplots(1, 2), (first - 3, first), strict=True):
        view = survey.view(number)
        pairs = segment_pairs(straight_edges(view.image), 4.0, 12.0)
        _photo(axes, survey.images[number])
        for pair in pairs.ends:
            axes.plot(*pair.T, "-", color=ORANGE, lw=2)
        axes.plot(*project(view, np.stack([pipe.start, pipe.end]))[0].T, "-", color=BLUE, lw=1)
        middle = project(view, pipe.middle[None])[0][0]
        axes.set(xlim=(middle[0] - 330, middle[0] + 330), ylim=(middle[1] + 200, middle[1] - 200))
        axes.set_title(f"keyframe {number + 1}: segment pairs (orange), the pipe (blue)")


def classes(survey: Survey, figure: Figure) -> None:
    """Radii against the planned classes."""
    axes = figure.subplots()
    radii = np.array([entry["radius"] for entry in survey.result["pipes"]]) * 1e3
    sigmas = np.array([entry["radius_sigma"] for entry in survey.result["pipes"]]) * 1e3
    grid = np.linspace(0, 125, 5000)
    for entry in survey.result["classes"]:
        nominal = 1e3 * entry["outer_radius"]
        tolerance = max(0.01 * nominal, 0.1)
        axes.fill_between(grid, np.exp(-0.5 * ((grid - nominal) / tolerance) ** 2), color=GREEN, alpha=0.3, lw=0)
        axes.annotate(f"{entry['class']}\n{nominal:g} mm", (nominal, 1.03), ha="center", fontsize=8)
    heights = 0.15 + 0.09 * np.arange(len(radii))
    axes.errorbar(radii, heights, xerr=4 * sigmas, fmt="o", color=BLUE, ms=4, capsize=3, label="pipes, ± 4 sigma")
    names = [entry["class_kmeans"] for entry in survey.result["pipes"]]
    means = [float(np.mean([r for r, other in zip(radii, names, strict=True) if other == name])) for name in set(names)]
    axes.plot(means, np.full(len(means), 0.05), "x", color=RED, ms=6, label="means of k-means")
    axes.set(xlabel="outer radius [mm]", yticks=[], ylim=(0, 1.25), xlim=(0, 125))
    axes.legend(loc="center", bbox_to_anchor=(0.78, 0.5))


def runs(survey: Survey, figure: Figure) -> None:
    """Pipes and the runs that fittings make of them, seen from the front."""
    axes = figure.subplots()
    palette = (BLUE, ORANGE, GREEN, RED, "#6a4fb3")
    pipes = {entry["id"]: entry for entry in survey.result["pipes"]}
    for color, run in zip(palette, survey.result["runs"], strict=False):
        for name in run["pipes"]:
            pipe = survey.pipe(name)
            side = np.cross(pipe.axis, [0.0, 1.0, 0.0])
            corners = [pipe.start + pipe.radius * side, pipe.end + pipe.radius * side]
            corners += [pipe.end - pipe.radius * side, pipe.start - pipe.radius * side]
            axes.fill(*np.array(corners)[:, [0, 2]].T, color=color, alpha=0.5, lw=0)
            axes.annotate(name, (pipe.middle[0], pipe.middle[2]), ha="center", va="center", fontsize=8)
        for joint in run["joints"]:
            tips = [np.array([pipes[name]["start"], pipes[name]["end"]]) for name in joint["pipes"]]
            gaps = [(float(np.linalg.norm(a - b)), a, b) for a in tips[0] for b in tips[1]]
            _, a, b = min(gaps, key=lambda gap: gap[0])
            axes.plot([a[0], b[0]], [a[2], b[2]], "--", color=color, lw=2)
            axes.annotate(joint["kind"], ((a[0] + b[0]) / 2 + 0.03, (a[2] + b[2]) / 2), fontsize=8)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", title="one colour a run")


def _contour_lines(pipe: Cylinder, view: View) -> tuple[FloatArray, float]:
    """The apparent contour's lines (2 sides, 2 ends, 2) [px] over the barrel, and their distance in the middle [px]."""
    at = contour_samples(pipe, [view], np.eye(3)[:2], 1.0, margin=-np.inf)
    lines = np.stack([at.pixel[at.side == side][[0, -1]] for side in (0, 1)])
    return lines, float(np.linalg.norm(lines[0].mean(axis=0) - lines[1].mean(axis=0)))


def _draw_conic(axes: Axes, conic: FloatArray) -> None:
    """The ellipse of a conic (3, 3)."""
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[2, :2] @ centre)
    values, vectors = np.linalg.eigh(conic[:2, :2] / level)
    size = 2 / np.sqrt(values)
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    axes.add_patch(Ellipse(tuple(centre), size[0], size[1], angle=angle, fill=False, ec=GREEN, lw=1))


def _photo(axes: Axes, image: NDArray[np.uint8]) -> None:
    axes.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    axes.set(xticks=[], yticks=[])


# Each stage with its height over its width.
STAGES: dict[Callable[[Survey, Figure], None], float] = {
    **dict.fromkeys((frames, contour, thin, ends), 0.36),
    depth: 0.3,
    **dict.fromkeys((votes, fit), 0.42),
    **dict.fromkeys((matches, classes), 0.32),
    **dict.fromkeys((poses, runs, board, planes), 0.45),
}


def main(folder: Path, names: list[str]) -> None:
    """Write all pictures, or those named."""
    survey = Survey(folder)
    for stage, height in STAGES.items():
        if names and stage.__name__ not in names:
            continue
        figure = Figure(figsize=(WIDTH / DPI, height * WIDTH / DPI), layout="constrained")
        figure.set_dpi(DPI)
        stage(survey, figure)
        for axes in figure.axes:
            axes.title.set_fontsize(9)
            axes.tick_params(labelsize=7)
            axes.xaxis.label.set_fontsize(8)
            axes.yaxis.label.set_fontsize(8)
            if legend := axes.get_legend():
                for text in legend.get_texts():
                    text.set_fontsize(7)
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=DPI, format="png")
        picture = Image.open(drawn).convert("RGB").quantize(COLORS, Image.Quantize.FASTOCTREE)
        target = IMAGES / f"method_{stage.__name__}.png"
        picture.save(target, optimize=True)
        print(f"{target.name}: {target.stat().st_size / 1024:.0f} kB", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "demo", sys.argv[2:])
