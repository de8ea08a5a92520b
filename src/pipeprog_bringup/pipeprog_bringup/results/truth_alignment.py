# SPDX-License-Identifier: Apache-2.0
"""How a trajectory lies on the poses of the ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeprog_bringup.results.result_files import read_frame_stamps, read_trajectory
from pipeprog_bringup.results.scored_files import Truth, read_truth
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.similarity import similarity

# Stamps in trajectory.tum are seconds as decimals, which other tools round to milliseconds at worst.
STAMP_TOLERANCE = 1_000_000  # ns


@dataclass(frozen=True)
class Alignment:
    """How the cameras fit the truth after alignment: `scale_error` relative, residuals [m]."""

    world_from_map: FloatArray
    poses: int
    scale_error: float
    rms_rigid: float
    rms_similarity: float
    max_similarity: float


def aligned(trajectory_file: Path, truth_json: Path) -> Alignment:
    """How a trajectory.tum, with the frames.csv beside it, lies on the truth's poses; raises InputError."""
    return align(*_pairs(trajectory_file, truth_json, read_truth(truth_json)))


def align(map_from_camera: FloatArray, world_from_camera: FloatArray) -> Alignment:
    """Lay a trajectory onto the truth, poses (N, 4, 4) each.

    The rigid motion for the pipes is fitted to positions and directions together: on a straight walk the positions
    alone leave the turn about the walk open. Scale and residuals are of the positions alone (Umeyama 1991).
    """
    positions, true_positions = map_from_camera[:, :3, 3], world_from_camera[:, :3, 3]
    spread = float(np.sqrt(((true_positions - true_positions.mean(0)) ** 2).sum(1).mean()))
    if len(positions) < 3 or spread < 1e-3:
        raise InputError(f"{len(positions)} poses within {spread * 1e3:.1f} mm are too few to align with the truth")
    tripod = np.array([[0, 0, 0, 1], [spread, 0, 0, 1], [0, spread, 0, 1], [0, 0, spread, 1]]).T
    corners = np.swapaxes(map_from_camera @ tripod, 1, 2)[..., :3].reshape(-1, 3)
    true_corners = np.swapaxes(world_from_camera @ tripod, 1, 2)[..., :3].reshape(-1, 3)
    rigid_residuals = _residuals(positions, true_positions, similarity(positions, true_positions, scaled=False))
    world_from_map = similarity(positions, true_positions)
    residuals = _residuals(positions, true_positions, world_from_map)
    return Alignment(
        world_from_map=similarity(corners, true_corners, scaled=False),
        poses=len(positions),
        scale_error=1 / float(np.cbrt(np.linalg.det(world_from_map[:3, :3]))) - 1,
        rms_rigid=_root_mean_square(rigid_residuals),
        rms_similarity=_root_mean_square(residuals),
        max_similarity=float(residuals.max()),
    )


def _pairs(trajectory_file: Path, truth_json: Path, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Poses of the run and of the truth that belong together."""
    stamps, map_from_camera = read_trajectory(trajectory_file)
    frame_stamps = read_frame_stamps(trajectory_file.parent / "frames.csv")
    if truth.stamps is not None and np.isin(frame_stamps, truth.stamps).any():
        frame_stamps = truth.stamps
    if len(frame_stamps) > len(truth.world_from_camera):
        raise InputError(
            f"{truth_json} has {len(truth.world_from_camera)} poses but {trajectory_file.parent / 'frames.csv'} "
            f"{len(frame_stamps)} frames: it is the truth of another recording"
        )
    unique, first = np.unique(frame_stamps, return_index=True)
    if not len(stamps) or not len(unique):
        raise InputError(f"{trajectory_file} holds no poses: nothing was reconstructed")
    after = np.clip(np.searchsorted(unique, stamps), 1, max(len(unique) - 1, 1))
    candidates = np.stack([np.minimum(after, len(unique) - 1), after - 1])
    gaps = np.abs(unique[candidates] - stamps)
    nearest = np.take_along_axis(candidates, gaps.argmin(0)[None], 0)[0]
    near = gaps.min(0) <= STAMP_TOLERANCE
    return map_from_camera[near], truth.world_from_camera[first[nearest[near]]]


def _residuals(points: FloatArray, true_points: FloatArray, transform: FloatArray) -> FloatArray:
    return np.linalg.norm(points @ transform[:3, :3].T + transform[:3, 3] - true_points, axis=1)


def _root_mean_square(residuals: FloatArray) -> float:
    return float(np.linalg.norm(residuals) / np.sqrt(len(residuals)))
