# SPDX-License-Identifier: Apache-2.0
"""Whether outlines of pipes sharpen the poses: both adjusted together, beside the poses of the points alone.

    .venv/bin/python -m benchmarks.joint_adjustment [demo] [lab:SEED] [BAG ...]

The recordings are replayed first, unless out/surveys has them; of global shutters, since a results folder tells no row
velocities. The pipes that were found and the poses of all keyframes are then unknowns of one robust least squares on
the limb edges. What the points tell of a pose enters as a standard deviation in the images, of which several are tried:
at 0 px the poses stay. The radii are measured anew at the poses of each. Writes results/joint_adjustment.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.ablations import Footage, Map
from benchmarks.recordings import Recording, named
from benchmarks.survey import RESULTS, RUNS, attempt, commit
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_bringup.results.truth_alignment import align
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.refinement.contour_adjustment import FLOOR, MODEL_ERROR, ROBUST, AdjustedCylinder, adjusted
from pipeprog_detect.silhouette.apparent_contour import parts_by_view
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, Pipe, View

TRIED = (0.0, 0.03, 0.1, 0.3)  # px that a pose may be off in its image: poses of good images, of bad ones, of none
START_SIGMA = 0.01  # m that a pipe's ends and radius may be off: far more than they are
ROUNDS = 15  # of the robust weights: the step of the last is below a micrometre
SEEN_AT = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-0.5, 0.0, 0.5], [2.5]), -1).reshape(-1, 3)  # m before the camera


@dataclass(frozen=True)
class Outline:
    """The limb edges of a pipe, and how they move: by 1 m of its step (N, 5), by 1 rad and 1 m of the poses (N, 6)."""

    found: AdjustedCylinder
    by_pose: FloatArray

    @classmethod
    def of(cls, found: AdjustedCylinder) -> Outline:
        """The outline of a pipe in its scene's views.

        A point X of the camera's frame moves by w x X + t. A contour's outward displacement is that of the point of the
        surface where the line of sight touches it: moving along the surface does not show.
        """
        samples, views = found.samples, found.scene.views
        by_pose = np.zeros((len(samples), 6))
        for index, part in parts_by_view(samples, len(views)):
            camera, depth, normal = views[index].camera, samples.depth[part], samples.normal[part]
            focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
            across = (samples.pixel[part] - centre) / focal
            gradient = np.column_stack([normal * focal, -(normal * focal * across).sum(axis=1)]) / depth[:, None]
            point = np.column_stack([across, np.ones(len(depth))]) * depth[:, None]
            by_pose[part] = np.column_stack([np.cross(point, gradient), gradient])
        return cls(found, by_pose)

    def seen(self, step: FloatArray, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offset (N,) [px] and weight (N,) [1/px^2] of the edges nearest to where `step` and `motion` put them.

        All edges of one line in one view share the limb model's error, however many they are.
        """
        samples, edges = self.found.samples, self.found.edges
        predicted = samples.jacobian @ step + (self.by_pose * motion[samples.view]).sum(axis=1)
        distance = np.where(np.isnan(edges.offset), np.inf, np.abs(edges.offset - predicted[:, None]))
        rows, nearest = np.arange(len(samples)), distance.argmin(axis=1)
        off, sigma = distance[rows, nearest], edges.sigma[rows, nearest]
        weight = np.zeros(len(samples))
        known = np.isfinite(off) & np.isfinite(sigma)
        weight[known] = 1.0 / (sigma[known] ** 2 + FLOOR**2) / (1.0 + (off[known] / ROBUST) ** 2)
        line = 2 * samples.view + samples.side
        weight /= 1.0 + np.bincount(line, weight)[line] * MODEL_ERROR**2
        return np.where(known, edges.offset[rows, nearest], 0.0), weight


def pose_motions(outlines: Sequence[Outline], views: Sequence[View], sigma: float) -> FloatArray:
    """Motion (V, 6) [rad, m] of each camera's frame, of which `sigma` [px] in its image is known; pipes are free.

    Normal equations with the poses eliminated (Schur complement): each outline ties its pipe to the views.
    """
    focal = float(np.median([view.camera.fx for view in views]))
    depth = float(np.median(np.concatenate([outline.found.samples.depth for outline in outlines])))
    known = np.diag(np.repeat([focal / sigma, focal / (sigma * depth)], 3) ** 2)
    steps: FloatArray = np.zeros((len(outlines), 5))
    motion: FloatArray = np.zeros((len(views), 6))
    for _ in range(ROUNDS):
        poses, pulled = np.tile(known, (len(views), 1, 1)), np.zeros((len(views), 6))
        size = 5 * len(outlines)
        normal, right = np.eye(size) / START_SIGMA**2, np.zeros(size)
        ties = np.zeros((len(views), 6, size))
        for number, outline in enumerate(outlines):
            offset, weight = outline.seen(steps[number], motion)
            own, samples = slice(5 * number, 5 * number + 5), outline.found.samples
            weighted = samples.jacobian * weight[:, None]
            normal[own, own] += weighted.T @ samples.jacobian
            right[own] += weighted.T @ offset
            for index, part in parts_by_view(samples, len(views)):
                moving = outline.by_pose[part] * weight[part, None]
                poses[index] += moving.T @ outline.by_pose[part]
                pulled[index] += moving.T @ offset[part]
                ties[index][:, own] += moving.T @ samples.jacobian[part]
        freed = np.linalg.solve(poses, ties)
        normal -= np.einsum("vik,vil->kl", ties, freed)
        right -= np.einsum("vik,vi->k", freed, pulled)
        step = np.linalg.solve(normal, right)
        steps = np.asarray(step.reshape(-1, 5), np.float64)
        motion = np.asarray(np.linalg.solve(poses, (pulled - ties @ step)[..., None])[..., 0], np.float64)
    return motion


def moved(views: Sequence[View], motion: FloatArray) -> list[View]:
    """The views after motions (V, 6) of their cameras' frames."""
    result = []
    for view, (*turn, x, y, z) in zip(views, motion, strict=True):
        by = np.eye(4)
        by[:3, :3], by[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), (x, y, z)
        result.append(replace(view, camera_from_map=by @ view.camera_from_map))
    return result


def outlines(cylinders: Sequence[Cylinder], views: Sequence[View]) -> list[AdjustedCylinder | None]:
    """Each cylinder adjusted at the views' poses; None where its outline is not seen."""
    result = []
    for number, cylinder in enumerate(cylinders):
        scene = Scene.of(cylinder, views, [*cylinders[:number], *cylinders[number + 1 :]])
        scene = replace(scene, blur=scene.measured_blur())
        found = adjusted(scene, np.eye(5) / START_SIGMA**2, np.zeros(5))
        result.append(found if found is not None and found.share >= MIN_SUPPORT else None)
    return result


def image_error(map_from_camera: FloatArray, truth: FloatArray, focal: float) -> float:
    """By how much the poses (N, 4, 4), laid onto the true ones, are off in the images at SEEN_AT [px rms]."""
    laid = align(map_from_camera, truth).world_from_map @ map_from_camera
    between = np.linalg.inv(laid) @ truth
    seen = np.einsum("nij,kj->nki", between[:, :3, :3], SEEN_AT) + between[:, None, :3, 3]
    off = seen[..., :2] / seen[..., 2:] - SEEN_AT[:, :2] / SEEN_AT[:, 2:]
    return float(focal * np.sqrt((off**2).sum(axis=2).mean()))


def rows(recording: Recording) -> list[dict[str, Any]]:
    """A row for each standard deviation that is tried."""
    attempt(recording)
    run, footage = RUNS / recording.name, Footage(recording)
    stamps, poses = read_trajectory(run / "trajectory.tum")
    taken = Map(read_cloud(run / "cloud.ply").cloud, stamps, poses)
    views = footage.views(taken)
    pipes = detect(taken.cloud, footage.boq, DetectConfig(), views)
    judging = with_depths(views, taken.cloud.points)
    cylinders = [pipe.cylinder for pipe in pipes]
    as_given = outlines(cylinders, judging)
    seen = [Outline.of(each) for each in as_given if each is not None]
    number = {stamp: index for index, stamp in enumerate(sorted(footage.encoded))}
    truth = footage.truth.world_from_camera[[number[stamp] for stamp in stamps.tolist()]]
    table = []
    for sigma in TRIED:
        tried = moved(judging, pose_motions(seen, judging, sigma)) if sigma else judging
        map_from_camera = np.linalg.inv(np.stack([view.camera_from_map for view in tried])).astype(np.float64)
        found = outlines(cylinders, tried) if sigma else as_given
        again = [_measured(*pair) for pair in zip(pipes, found, strict=True)]
        figures = footage.figures(again, replace(taken, map_from_camera=map_from_camera))
        errors = np.array(figures["radius_errors_mm"])
        table.append(
            {
                "recording": recording.name,
                "keyframes": len(views),
                "outlines": len(seen),
                "poses known to [px]": sigma,
                "camera path [mm]": round(1e3 * align(map_from_camera, truth).rms_rigid, 3),
                "poses off in the image [px]": round(image_error(map_from_camera, truth, footage.camera.fx), 3),
                "radius RMSE [mm]": round(float(np.sqrt(np.mean(errors**2))), 3),
            }
        )
        print(table[-1], flush=True)
    return table


def _measured(pipe: Pipe, found: AdjustedCylinder | None) -> Pipe:
    return pipe if found is None else replace(pipe, cylinder=found.cylinder)


def main() -> None:
    """Measure the recordings that the command line names."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.joint_adjustment",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recordings", nargs="*", default=["demo"])
    recordings = [named(text) for text in parser.parse_args().recordings]
    table = [row for recording in recordings for row in rows(recording)]
    content = {
        "title": "Poses and pipes adjusted together",
        "command": f"python -m benchmarks.joint_adjustment {' '.join(each.name for each in recordings)}",
        "commit": commit(),
        "rows": table,
    }
    (RESULTS / "joint_adjustment.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
