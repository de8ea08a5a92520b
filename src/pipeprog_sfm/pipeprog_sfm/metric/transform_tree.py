# SPDX-License-Identifier: Apache-2.0
"""A robot's motion: transforms between frames as odometry and TF tell them, and accelerations."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray

MAX_GAP = 500_000_000  # ns between two poses that are interpolated; one step of a walk takes as long
MAX_SPEED = 30.0  # m/s; 108 km/h, faster than any robot that films pipes
MAX_JITTER = 0.1  # m, of a step at any speed: noise, and stamps that come in bursts
MAX_JUMPS = 0.01  # of the steps, and two in any case: one wrong pose, or a few corrections of a map, do no harm
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
    """The transforms do not lead from one frame to another, or jump; the text says where."""


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
            NoPathError: nothing above the camera moves, or what moves there jumps.
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


def _jumps(stamps: NDArray[np.int64], places: FloatArray) -> tuple[int, int]:
    """How many steps between places (N, 3) at stamps (N,), ascending, are faster than a robot; and how many there are.

    Two robots on one topic, or a wrong unit, jump all the time.
    """
    gaps = np.diff(stamps)
    near = gaps <= MAX_GAP
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)[near]
    return int((lengths > MAX_JITTER + MAX_SPEED * 1e-9 * gaps[near]).sum()), int(near.sum())


def _interpolated(samples: Sequence[Transform], times: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Poses (M, 4, 4) at times (M,), and which of them (M,) have a sample close enough on both sides."""
    stamps, first = np.unique(np.array([sample.stamp for sample in samples], np.int64), return_index=True)
    stack = np.stack([samples[index].parent_from_child for index in first])
    jumps, steps = _jumps(stamps, stack[:, :3, 3])
    if jumps > max(MAX_JUMPS * steps, 2):
        raise NoPathError(
            f"{jumps} of {steps} steps of '{samples[0].child}' in '{samples[0].parent}' are faster than {MAX_SPEED:g} "
            "m/s: check that odometry is in metres, and that one robot alone publishes it"
        )
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    before = np.where(stamps[after] > times, after - 1, after)
    known = (before >= 0) & (stamps[after] >= times)
    before = np.maximum(before, 0)
    known &= stamps[after] - stamps[before] <= MAX_GAP
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    if not known.any():
        return poses, known
    # Times since the sample before, exact to the nanosecond however far apart the first and the last sample are.
    before, after = before[known], after[known]
    share = (times[known] - stamps[before]) / np.maximum(stamps[after] - stamps[before], 1)
    start, end = stack[before], stack[after]
    turn = Rotation.from_matrix(start[:, :3, :3].transpose(0, 2, 1) @ end[:, :3, :3]).as_rotvec()
    poses[known, :3, :3] = start[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    poses[known, :3, 3] = start[:, :3, 3] + share[:, None] * (end[:, :3, 3] - start[:, :3, 3])
    return poses, known
