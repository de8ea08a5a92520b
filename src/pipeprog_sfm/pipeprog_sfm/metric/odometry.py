"""The scale by odometry: how long the robot says its way was, over how long the model says it was."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.config import OdometryConfig
from pipeprog_sfm.metric.scale import Measurement, trajectory_gradient
from pipeprog_sfm.metric.transform_tree import CameraPath

SEGMENTS = 20  # of the way: long enough to drown the jitter of single poses, many enough to tell the odd ones
MIN_SEGMENTS = 4  # from which a spread can be told
CAUCHY = 2.385  # 95 % efficiency for normal errors (Holland, Welsch 1977)
MAX_MISFIT = 0.3  # median error of a segment over its length from which odometry and camera did not move together


class OdometryError(Exception):
    """The odometry tells no scale; the text says why."""


def odometry_measurement(path: CameraPath, poses: Mapping[int, FloatArray], config: OdometryConfig) -> Measurement:
    """The scale by the displacements along the way, each as the camera at its beginning saw it.

    Displacements in the camera's own frame need no alignment of the two paths, and a heading that drifts or a wheel
    that slips spoils the segments where it does so, which robust weights then leave out. A random walk, as odometry
    errs, has variances in proportion to the way.

    Args:
        path: the camera's path by odometry.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        config: how good the odometry's own scale is.

    Raises:
        OdometryError: the way is too short, or not the camera's.
    """
    found = {int(stamp): pose for stamp, pose in zip(path.stamps, path.fixed_from_camera, strict=True)}
    stamps = [stamp for stamp in poses if stamp in found]
    if len(stamps) < 2:
        raise OdometryError(f"odometry covers {len(stamps)} of {len(poses)} keyframes only")
    ours = np.stack([np.linalg.inv(poses[stamp]) for stamp in stamps])
    theirs = np.stack([found[stamp] for stamp in stamps])
    steps = np.linalg.norm(np.diff(ours[:, :3, 3], axis=0), axis=1)
    way = np.append(0.0, np.cumsum(steps))
    wanted = np.searchsorted(way, np.linspace(0.0, way[-1], SEGMENTS + 1)).clip(0, len(way) - 1)
    ends = np.unique(wanted)
    if len(ends) <= MIN_SEGMENTS:
        raise OdometryError(f"odometry covers {len(stamps)} keyframes, too few for a scale")
    begin, end = ends[:-1], ends[1:]
    moved, told = (
        np.einsum("nji,nj->ni", path_[begin, :3, :3], path_[end, :3, 3] - path_[begin, :3, 3])
        for path_ in (ours, theirs)
    )
    length = way[end] - way[begin]
    scale = float(np.median(np.linalg.norm(told, axis=1) / np.maximum(np.linalg.norm(moved, axis=1), 1e-12)))
    if scale <= 0:
        raise OdometryError("odometry says that the camera stood still")
    misfit = np.linalg.norm(told - scale * moved, axis=1) / (scale * length)
    if np.median(misfit) > MAX_MISFIT:
        raise OdometryError(
            "odometry and camera did not move together: check the transform between them and that their clocks agree"
        )
    for _ in range(20):
        square = ((told - scale * moved) ** 2).sum(1) / length
        spread = max(1.4826 * float(np.median(np.sqrt(square))), 1e-9 * scale)  # of all three coordinates
        square /= (CAUCHY * spread) ** 2
        weight = 1.0 / (1.0 + square)
        scale = float((weight * (told * moved).sum(1) / length).sum() / (weight * (moved**2).sum(1) / length).sum())
    # The sandwich of an M-estimator, segments being independent; the loss curves less than its weights say.
    curvature = float((weight - 2 / 3 * square * weight**2).mean() / weight.mean())
    lever = curvature * (weight * (moved**2).sum(1) / length).sum()
    score = weight * ((told - scale * moved) * moved).sum(1) / length
    spread = float(np.sqrt((score**2).sum() * len(length) / (len(length) - 1)) / lever / scale)
    sigma = float(np.hypot(spread, config.scale_sigma))
    # It is measured all along the trajectory: what the poses err by shows in the spread.
    return Measurement(
        "odometry", f"odometry in '{path.fixed}'", float(np.log(scale)), sigma, -trajectory_gradient(poses)
    )
