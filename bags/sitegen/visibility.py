# SPDX-License-Identifier: Apache-2.0
"""What a recording shows of a site: coverage of each pipe, and the true surface that the camera saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitegen.render import Lens, Scene, build_scene, trace
from sitegen.site import Pipe, Site
from sitegen.walk import Walk

FloatArray = NDArray[np.float64]

_STEP = 0.02  # m, length of a bin along a pipe
_MIN_FRAMES = 3  # two views give a depth, a third confirms it
_MIN_SHARE = 0.6  # of the length: a pipe is then longer than its gaps
_PROBE = Lens(214, 120, 153.0, 153.0, 106.5, 59.5)


@dataclass(frozen=True)
class Coverage:
    """How a pipe was seen: frames with any of it, share of its length seen in at least three of them."""

    frames: int
    share: float

    @property
    def enough(self) -> bool:
        """Whether a recording with this pipe is a fair test."""
        return self.frames >= _MIN_FRAMES and self.share >= _MIN_SHARE


def coverage(scene: Scene, pipes: Sequence[Pipe], lens: Lens, poses: FloatArray) -> list[Coverage]:
    """Coverage of every pipe over (N, 4, 4) poses."""
    bins = [np.zeros(max(int(np.ceil(p.length / _STEP)), 1), np.int64) for p in pipes]
    frames = np.zeros(len(pipes), np.int64)
    axes = [(p.end - p.start) / p.length for p in pipes]
    for pose in poses:
        hit, points, _ = trace(scene, lens, pose)
        owner = np.where(hit >= 0, scene.pipes[hit], -1)
        for index in np.unique(owner[owner >= 0]):
            along = (points[owner == index] - pipes[index].start) @ axes[index]
            seen = np.unique(np.clip((along / _STEP).astype(np.int64), 0, len(bins[index]) - 1))
            bins[index][seen] += 1
            frames[index] += 1
    return [Coverage(int(n), float(np.mean(b >= _MIN_FRAMES))) for n, b in zip(frames, bins, strict=True)]


def shows_every_pipe(site: Site) -> bool:
    """Whether a steady walk along the site's waypoints shows enough of each of its pipes."""
    walk = Walk(site.waypoints, 1.0, np.random.default_rng(0), False, 0.0)
    scene = build_scene(site.primitives, site.lamps, site.ambient, 0)
    poses = walk.poses(np.arange(0.0, walk.duration, 0.3))
    return all(seen.enough for seen in coverage(scene, site.pipes, _PROBE, poses))


def visible_surface(scene: Scene, lens: Lens, poses: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Points (N, 3) of the true surfaces that the poses see, and the pipe (N,) each lies on, or -1."""
    points: list[NDArray[np.float32]] = []
    owners: list[NDArray[np.int32]] = []
    for pose in poses:
        hit, where, _ = trace(scene, lens, pose)
        keep = hit >= 0
        points.append(where[keep].astype(np.float32))
        owners.append(scene.pipes[hit[keep]].astype(np.int32))
    return np.concatenate(points), np.concatenate(owners)
