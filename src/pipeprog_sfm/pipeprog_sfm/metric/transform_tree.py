# SPDX-License-Identifier: Apache-2.0
"""A robot's motion: transforms between frames as odometry and TF tell them, and accelerations."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from pipeprog_camera.arrays import FloatArray

MAX_GAP = 500_000_000  # ns between two poses that are interpolated; one step of a walk takes as long
ODOMETRY_FRAME = "odom"  # REP 105: continuous, while the frames above it may jump


@dataclass(frozen=True)
class Transform:
    """parent_from_child (4, 4) at a time [ns], from odometry or TF; a static one holds at all times."""

    stamp: int
    parent: str
    child: str
    parent_from_child: FloatArray
    static: bool = False


@dataclass(frozen=True)
class Acceleration:
    """Specific force (3,) in m/s^2, what an accelerometer feels, in the frame `frame` at a time [ns]."""

    stamp: int
    frame: str
    force: FloatArray


@dataclass(frozen=True)
class RobotMotion:
    """Transforms and accelerations received, in any order."""

    transforms: tuple[Transform, ...] = ()
    accelerations: tuple[Acceleration, ...] = ()


@dataclass(frozen=True)
class CameraPath:
    """fixed_from_camera (M, 4, 4) at stamps (M,) [ns] in order of time, in the frame `fixed`."""

    fixed: str
    stamps: NDArray[np.int64]
    fixed_from_camera: FloatArray


class NoPathError(Exception):
    """The transforms do not lead from one frame to another; the text says where they end."""


class TransformTree:
    """Transforms as they come; looked up by interpolation, never extrapolated."""

    def __init__(self) -> None:
        self._static: dict[str, Transform] = {}
        self._moving: dict[str, dict[str, list[Transform]]] = {}

    def __bool__(self) -> bool:
        return bool(self._moving)

    def add(self, transforms: Iterable[Transform]) -> None:
        """Takes transforms in any order; the result does not depend on it."""
        for transform in transforms:
            if transform.static:
                self._static[transform.child] = transform
            else:
                samples = self._moving.setdefault(transform.child, {}).setdefault(transform.parent, [])
                insort(samples, transform, key=lambda one: (one.stamp, one.parent_from_child.tobytes()))

    def path(self, camera: str, stamps: Sequence[int]) -> CameraPath:
        """Poses of the frame `camera` in the frame at the root of its tree, at those stamps [ns] that are covered.

        The root is the odometry frame of REP 105 where there is one, since frames above it may jump.

        Raises:
            NoPathError: nothing above the camera moves.
        """
        chain = [camera]
        while (parent := self._parent(chain[-1])) and parent not in chain:
            chain.append(parent)
            if parent.rpartition("/")[2] == ODOMETRY_FRAME:
                break
        if all(child in self._static for child in chain[:-1]):
            moving = ", ".join(sorted(self._moving))
            raise NoPathError(
                f"odometry moves {moving}, and no transform leads from there to the camera's frame '{camera}'"
                + (f" (from which they lead to '{chain[-1]}')" if len(chain) > 1 else "")
                + ": publish where the camera is mounted on /tf_static"
            )
        times = np.asarray(stamps, np.int64)
        covered: NDArray[np.bool_] = np.ones(len(times), bool)
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for child, parent in pairwise(chain):
            if child in self._static:
                poses = self._static[child].parent_from_child @ poses
            else:
                found, known = _interpolated(self._moving[child][parent], times)
                poses, covered = found @ poses, covered & known
        return CameraPath(chain[-1], times[covered], poses[covered])

    def static_transform(self, to: str, source: str) -> FloatArray:
        """(4, 4) to_from_source of two frames mounted on one body; raises NoPathError."""
        above = {to: np.eye(4)}
        frame, pose = to, np.eye(4)
        while frame in self._static and self._static[frame].parent not in above:
            pose = self._static[frame].parent_from_child @ pose
            frame = self._static[frame].parent
            above[frame] = pose
        frame, pose, passed = source, np.eye(4), {source}
        while frame not in above:
            if frame not in self._static or self._static[frame].parent in passed:
                raise NoPathError(
                    f"no static transform connects '{source}' with the camera's frame '{to}': publish how both are "
                    "mounted on /tf_static"
                )
            pose = self._static[frame].parent_from_child @ pose
            frame = self._static[frame].parent
            passed.add(frame)
        return np.linalg.inv(above[frame]) @ pose

    def _parent(self, child: str) -> str:
        """The frame above, "" at the root; of several the one that occurs most often."""
        if child in self._static:
            return self._static[child].parent
        parents = self._moving.get(child, {})
        return max(sorted(parents), key=lambda parent: len(parents[parent]), default="")


def _interpolated(samples: Sequence[Transform], times: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Poses (M, 4, 4) at times (M,), and which of them (M,) have a sample close enough on both sides."""
    stamps, first = np.unique(np.array([sample.stamp for sample in samples], np.int64), return_index=True)
    stack = np.stack([samples[index].parent_from_child for index in first])
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    before = np.where(stamps[after] > times, after - 1, after)
    known = (before >= 0) & (stamps[after] >= times)
    before = np.maximum(before, 0)
    known &= stamps[after] - stamps[before] <= MAX_GAP
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    if not known.any():
        return poses, known
    inside = np.clip(times, stamps[0], stamps[-1])
    if len(stamps) == 1:
        return np.repeat(stack, len(times), axis=0), known
    seconds = (stamps - stamps[0]) * 1e-9
    at = (inside - stamps[0]) * 1e-9
    poses[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(stack[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        poses[:, axis, 3] = np.interp(at, seconds, stack[:, axis, 3])
    return poses, known
