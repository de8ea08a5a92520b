# SPDX-License-Identifier: Apache-2.0
"""The scale by odometry: displacements as the robot tells them, over those of the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board_covariance import CAUCHY
from pipeprog_sfm.config import OdometryConfig
from pipeprog_sfm.metric.scale import Measurement
from pipeprog_sfm.metric.transform_tree import CameraPath

SEGMENTS = 20  # of the way: long against the jitter of single poses, and enough of them to reject outliers
MIN_SEGMENTS = 4  # more than these, to estimate a standard deviation from their scatter
MIN_WAY = 0.01  # m, of the whole way; less is the jitter of an odometry that stands still
MAX_MISFIT = 0.3  # median error of a segment over its length; above, the transform or the clocks must be wrong
ROUNDS = 20  # of reweighting, each of which at least halves the distance from the limit: to 1e-6 of it


class OdometryError(Exception):
    """The odometry gives no scale; the text says why."""


@dataclass(frozen=True)
class _Segments:
    """Displacements over pieces of the way, each in the camera's frame at its beginning.

    Attributes:
        moved: (S, 3) in the model, model units.
        told: (S, 3) by odometry, m.
        length: (S,) of the way, model units.
    """

    moved: FloatArray
    told: FloatArray
    length: FloatArray


def odometry_measurement(path: CameraPath, poses: Mapping[int, FloatArray], config: OdometryConfig) -> Measurement:
    """The scale by displacements along the way, each in the frame of the camera at its beginning.

    Displacements in the camera's own frame need no alignment of the two paths. A drifting heading or a slipping wheel
    spoils only the segments where it happens, and robust weights reject these. Odometry's error is a random walk,
    whose variance is proportional to the length of the way.

    Args:
        path: the camera's path by odometry.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        config: standard deviation of odometry's own scale.

    Raises:
        OdometryError: the way is too short, or not the camera's.
    """
    segments = _segments(path, poses)
    scale, spread = _robust_scale(segments, _median_scale(segments))
    sigma = float(np.hypot(spread, config.scale_sigma))
    # Odometry spans the whole trajectory: what the poses' errors add is part of the scatter.
    return Measurement.of_trajectory("odometry", f"odometry in '{path.fixed}'", scale, sigma, poses)


def _segments(path: CameraPath, poses: Mapping[int, FloatArray]) -> _Segments:
    """Up to SEGMENTS pieces of equal length; raises OdometryError where there are too few."""
    found = {int(stamp): pose for stamp, pose in zip(path.stamps, path.fixed_from_camera, strict=True)}
    stamps = [stamp for stamp in poses if stamp in found]
    if len(stamps) < 2:
        raise OdometryError(f"odometry covers {len(stamps)} of {len(poses)} keyframes only")
    model_from_camera = np.stack([np.linalg.inv(poses[stamp]) for stamp in stamps])
    fixed_from_camera = np.stack([found[stamp] for stamp in stamps])
    steps = np.linalg.norm(np.diff(model_from_camera[:, :3, 3], axis=0), axis=1)
    way = np.append(0.0, np.cumsum(steps))
    wanted = np.searchsorted(way, np.linspace(0.0, way[-1], SEGMENTS + 1)).clip(0, len(way) - 1)
    ends = np.unique(wanted)
    if len(ends) <= MIN_SEGMENTS:
        raise OdometryError(f"odometry covers {len(stamps)} keyframes, too few for a scale")
    return _Segments(
        _displacements(model_from_camera, ends), _displacements(fixed_from_camera, ends), np.diff(way[ends])
    )


def _displacements(from_camera: FloatArray, ends: Sequence[int]) -> FloatArray:
    """(S, 3) from each end to the next, in the camera's frame at the first."""
    begin, end = from_camera[ends[:-1]], from_camera[ends[1:]]
    return np.einsum("nji,nj->ni", begin[:, :3, :3], end[:, :3, 3] - begin[:, :3, 3])


def _median_scale(segments: _Segments) -> float:
    """Metres per model unit; raises OdometryError where odometry and camera did not move together."""
    moved, told = segments.moved, segments.told
    scale = float(np.median(np.linalg.norm(told, axis=1) / np.maximum(np.linalg.norm(moved, axis=1), 1e-12)))
    if scale * segments.length.sum() < MIN_WAY:
        raise OdometryError("odometry says that the camera stood still")
    misfit = np.linalg.norm(told - scale * moved, axis=1) / (scale * segments.length)
    if np.median(misfit) > MAX_MISFIT:
        raise OdometryError(
            "odometry and camera did not move together: check the transform between them and that their clocks agree"
        )
    return scale


def _robust_scale(segments: _Segments, scale: float) -> tuple[float, float]:
    """Metres per model unit by Cauchy's M-estimator, and its relative standard deviation from the scatter."""
    moved, told, length = segments.moved, segments.told, segments.length
    for _ in range(ROUNDS):
        square = ((told - scale * moved) ** 2).sum(1) / length
        spread = max(1.4826 * float(np.median(np.sqrt(square))), 1e-9 * scale)  # of all three coordinates
        square /= (CAUCHY * spread) ** 2
        weight = 1.0 / (1.0 + square)
        scale = float((weight * (told * moved).sum(1) / length).sum() / (weight * (moved**2).sum(1) / length).sum())
    # Sandwich estimate of independent segments; the loss has less curvature than its weights alone.
    curvature = float((weight - 2 / 3 * square * weight**2).mean() / weight.mean())
    lever = curvature * (weight * (moved**2).sum(1) / length).sum()
    score = weight * ((told - scale * moved) * moved).sum(1) / length
    return scale, float(np.sqrt((score**2).sum() * len(length) / (len(length) - 1)) / lever / scale)
