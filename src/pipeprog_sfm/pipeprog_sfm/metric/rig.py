# SPDX-License-Identifier: Apache-2.0
"""The scale by a camera rig: the baseline of two cameras as /tf_static has it, over that in the model."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board_covariance import CAUCHY
from pipeprog_sfm.config import OdometryConfig
from pipeprog_sfm.metric.scale import Measurement, ScaleWarning
from pipeprog_sfm.metric.transform_tree import NoPathError, TransformTree

MAX_SKEW = (
    1_000_000  # ns between the images of a pair: walking at 1 m/s the body moves by 1 mm, far less than a baseline
)
MIN_PAIRS = 3  # of images, to estimate a standard deviation from their scatter
MAX_MISFIT = 0.3  # median error of a pair over the baseline; above, the mounting or the clocks must be wrong
ROUNDS = 20  # of reweighting, each of which at least halves the distance from the limit: to 1e-6 of it


class RigError(Exception):
    """Two cameras give no scale; the text says why."""


def rig_measurements(
    frames: Mapping[int, str], transforms: TransformTree, poses: Mapping[int, FloatArray], config: OdometryConfig
) -> list[Measurement | ScaleWarning]:
    """The scale by each two cameras of one body; a warning for two that do not give it.

    Args:
        frames: optical frame of each image, by stamp [ns].
        transforms: static ones lead from one camera to the other.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        config: standard deviation of the baseline.
    """
    found: list[Measurement | ScaleWarning] = []
    for one, other in combinations(sorted(set(frames.values())), 2):
        try:
            one_from_other = transforms.static_transform(one, other)
            found.append(_measurement((one, other), one_from_other, frames, poses, config))
        except (NoPathError, RigError) as error:
            found.append(ScaleWarning(str(error)))
    return found


def _measurement(
    cameras: tuple[str, str],
    one_from_other: FloatArray,
    frames: Mapping[int, str],
    poses: Mapping[int, FloatArray],
    config: OdometryConfig,
) -> Measurement:
    """The robust mean, over pairs of images, of the model's baseline projected on the given one.

    Noise of the poses leaves the projection unbiased; the length of the model's baseline would be too long.
    """
    names = "the cameras '{}' and '{}'".format(*cameras)
    baseline = one_from_other[:3, 3]
    length = float(np.linalg.norm(baseline))
    if MAX_MISFIT * length < config.baseline_sigma:
        raise RigError(f"{names} are at one place by /tf_static: they give no scale")
    pairs = _pairs(cameras, frames, poses)
    if len(pairs) < MIN_PAIRS:
        raise RigError(
            f"{len(pairs)} images of {names} are of one moment (within {MAX_SKEW * 1e-6:g} ms): too few for a scale"
        )
    first, second = (np.stack([poses[pair[side]] for pair in pairs]) for side in (0, 1))
    centres = -np.einsum("nji,nj->ni", second[:, :3, :3], second[:, :3, 3])
    found = np.einsum("nij,nj->ni", first[:, :3, :3], centres) + first[:, :3, 3]
    along = found @ baseline / length**2  # model units per metre
    scale = 1.0 / max(float(np.median(along)), 1e-12)
    if np.median(np.linalg.norm(scale * found - baseline, axis=1)) > MAX_MISFIT * length:
        raise RigError(f"{names} are not mounted as /tf_static says, or their clocks do not agree")
    mean = float(np.median(along))
    for _ in range(ROUNDS):
        square = (along - mean) ** 2
        spread = max(1.4826 * float(np.median(np.sqrt(square))), 1e-9 * mean)
        weight = 1.0 / (1.0 + square / (CAUCHY * spread) ** 2)
        weight /= weight.sum()
        mean = float(weight @ along)
    sigma = np.hypot(np.sqrt(weight**2 @ (along - mean) ** 2) / mean, config.baseline_sigma / length)
    return Measurement(
        "rig", names, -float(np.log(mean)), float(sigma), _gradient(pairs, weight / mean, baseline / length**2, poses)
    )


def _pairs(
    cameras: tuple[str, str], frames: Mapping[int, str], poses: Mapping[int, FloatArray]
) -> list[tuple[int, int]]:
    """Stamps of images taken within MAX_SKEW, each used once at most."""
    first, second = (np.array([stamp for stamp in poses if frames.get(stamp) == name], np.int64) for name in cameras)
    if not len(first) or not len(second):
        return []
    gap = np.abs(first[:, None] - second[None])
    nearest, back = gap.argmin(axis=1), gap.argmin(axis=0)
    return [
        (int(first[row]), int(second[column]))
        for row, column in enumerate(nearest)
        if back[column] == row and gap[row, column] <= MAX_SKEW
    ]


def _gradient(
    pairs: list[tuple[int, int]], weight: FloatArray, along: FloatArray, poses: Mapping[int, FloatArray]
) -> FloatArray:
    """(N, 6) derivatives of the logarithm of the scale by the poses, turned and shifted from the left."""
    row = {stamp: number for number, stamp in enumerate(poses)}
    gradient = np.zeros((len(poses), 6))
    for (first, second), share in zip(pairs, weight, strict=True):
        a, b = poses[first], poses[second]
        # Of along . (R_a c_b + t_a) with c_b = -R_b^T t_b.
        own = b[:3, :3] @ a[:3, :3].T @ along
        turned = -a[:3, :3] @ b[:3, :3].T @ b[:3, 3]
        gradient[row[first]] -= share * np.r_[np.cross(turned, along), along]
        gradient[row[second]] -= share * np.r_[np.cross(b[:3, 3], own), -own]
    return gradient
