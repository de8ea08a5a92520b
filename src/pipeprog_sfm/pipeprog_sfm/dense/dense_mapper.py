# SPDX-License-Identifier: Apache-2.0
"""The dense cloud of a stream of keyframes: which of them get a depth map; made and fused in threads of their own."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.cores import usable_cores
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_camera.view_overlap import in_image, is_shown_beside, sample, view_overlap
from pipeprog_sfm.config import FusionConfig, StereoConfig
from pipeprog_sfm.dense.depth_fusion import FusedCloud, Fusion
from pipeprog_sfm.dense.stereo import (
    DepthMap,
    Picture,
    StereoImage,
    choose_pairs,
    depth_map,
    working_size,
)
from pipeprog_sfm.types import EncodedImage

LOOKAHEAD = 2  # later keyframes that a depth map waits for, so that it has neighbours on both sides
# ns that a keyframe of a rolling shutter waits beside: those between come up to 2.8 s later, where its neighbours have
# told that they are missing, and without them its velocity is off by 10 % and 0.1 rad/s, 1 px at the border of an image
# of 30 ms; with them by a tenth of that.
FILLED = 3_000_000_000
# Depth maps made at a time: each takes one core, and 130 MB at 720p.
THREADS = min(usable_cores(), 4)
PICTURES = 12  # of keyframes at working resolution, 15 MB each at 720p: neighbours are mostly the last few
NICENESS = 5  # of each thread, a third of the mapper's CPU share: the selector waits for poses, nobody for the cloud
MIN_POINTS = 10  # of a keyframe, for the percentiles of its depths
# A keyframe of which the newest one sees less than this share is left behind: no nearer one comes any more.
LEFT_BEHIND = 0.5
# Share of a keyframe's points that too few depth maps show, from which on it gets its own: that is what the margins of
# a swaying image show. The sample of its points tells it with a standard deviation of 0.014.
MARGIN = 0.04
# px, by which changes of the camera may move a point of the image before depth maps are made anew: the one that moves
# most; the others move by a third of it on average, about what matched patches err by.
OUTDATED = 0.5
# Depth maps given up whose points are in the cloud, per depth map held, from which on it is made anew. A place that is
# seen again and again adds noise on both sides of its surfaces. Each depth map given up costs two fusions more.
GIVEN_UP = 0.5
STILL = RowMotion(0.0, 1, np.zeros(3), np.zeros(3))  # all rows at the stamp, however many there are


@dataclass(frozen=True)
class Registered:
    """The registered keyframes, by stamp.

    Attributes:
        poses: (4, 4) camera_from_model.
        images: at least theirs.
        points: the (K, 3) points in the model that a keyframe sees.
        motions: how a rolling shutter shows them, in the model's unit; empty without one.
    """

    poses: Mapping[int, FloatArray]
    images: Mapping[int, EncodedImage]
    points: Callable[[int], FloatArray]
    motions: Mapping[int, RowMotion] = field(default_factory=dict)

    def __contains__(self, stamp: int) -> bool:
        return stamp in self.poses

    def __len__(self) -> int:
        return len(self.poses)

    def view(self, stamp: int) -> tuple[FloatArray, Camera]:
        """Pose and calibration of a keyframe."""
        return self.poses[stamp], self.images[stamp].camera

    def in_front(self, stamp: int) -> FloatArray:
        """Of the points of a keyframe those before its camera, (K, 3)."""
        pose, points = self.poses[stamp], self.points(stamp)
        return points[points @ pose[2, :3] + pose[2, 3] > 0]


@dataclass(frozen=True)
class _Source:
    """A keyframe of which, or with which, a depth map is made."""

    stamp: int
    image: EncodedImage
    pose: FloatArray
    motion: RowMotion | None

    def rolled(self, width: int) -> RolledImage | None:
        """Its rolling shutter at the working resolution."""
        if self.motion is None:
            return None
        whole = RolledImage(self.motion, self.image.camera)
        return whole.scaled(width / whole.camera.width) if width < whole.camera.width else whole


@dataclass(frozen=True)
class _Depth:
    map: DepthMap
    baselines: dict[int, float]  # to the neighbours that it was made with, in model units of that time


class DenseMapper:
    """Depth maps and their fusion, in threads of low priority beside the mapper.

    A keyframe gets a depth map unless another one shows nearly the same, and in the end enough of them what it shows at
    its margins: what is held grows with the map, not with the time spent in it. So it is, with a rolling shutter, with
    keyframes that came for the motion: those beside them show what they show. Depth maps are made with the poses of
    the call and fused in the order of the poses, so that the result does not depend on timing.
    """

    def __init__(self, stereo: StereoConfig, fusion: FusionConfig) -> None:
        self._stereo_config, self._fusion_config = stereo, fusion
        # On a straight walk a point is visible in 1 / (1 - overlap) depth maps. That is twice the number that must
        # agree on it: in the others it may be occluded, oblique, blurred, or too thin to be matched.
        self._overlap = 1.0 - 1.0 / (2 * fusion.min_views)
        self._picture = lru_cache(maxsize=PICTURES)(_picture)
        self._depths: dict[int, Future[_Depth]] = {}
        self._covered: dict[int, int] = {}  # keyframes without a depth map, and the one that shows the same
        self._between: set[int] = set()  # of these, those that came for the motion
        self._unsettled: deque[int] = deque()  # of these, those whose surroundings have not all got theirs
        self._shift = 0.0  # px, at most: by which the camera has changed since the first keyframe
        self._started_at: dict[int, float] = {}  # that shift when a depth map was started
        self._refused: dict[int, int] = {}  # keyframes without neighbours to match, and the size of the map then
        self._stereo = ThreadPoolExecutor(THREADS, initializer=_be_nice)
        self._fusing = ThreadPoolExecutor(1, initializer=_be_nice)
        self._fusion = Fusion(fusion)  # from here on the thread's own
        self._fused: dict[int, FloatArray] = {}

    def __len__(self) -> int:
        return len(self._depths)

    def update(self, keyframes: Registered, complete: bool) -> None:
        """Starts depth maps of the keyframes that have come, unless others show the same.

        With `complete` no keyframe comes any more, so that the last ones need not wait for their neighbours.
        """
        stamps = sorted(keyframes.poses)
        ready = stamps if complete else stamps[:-LOOKAHEAD]
        if keyframes.motions and not complete:
            ready = [stamp for stamp in ready if stamps[-1] - stamp > FILLED]
        for stamp in ready:
            grown = len(keyframes) > 1.1 * self._refused.get(stamp, 0) + 2
            if stamp not in self._depths and stamp not in self._covered and (grown or complete):
                self._consider(stamp, keyframes)
        if ready:
            self._settle(keyframes, stamps[: len(ready) + LOOKAHEAD][-1], complete)

    def retire(self, stamps: Collection[int]) -> None:
        """Gives up depth maps; what they showed is left to others again."""
        for stamp in stamps:
            self._refused.pop(stamp, None)
            self._covered.pop(stamp, None)
            if stamp in self._depths:
                self._depths.pop(stamp).cancel()
                del self._started_at[stamp]
        for stamp in [stamp for stamp, other in self._covered.items() if other in stamps]:
            del self._covered[stamp]
        self._between &= self._covered.keys()

    def close(self) -> None:
        """Gives up the depth maps that have not been begun, which the process would make before it ends."""
        self._stereo.shutdown(wait=False, cancel_futures=True)

    def change_camera(self, shift: float) -> None:
        """Notes that another calibration or read-out moves a point of the images by `shift` px at most.

        Small changes matter to the depth maps to come alone; those that were made before changes that add up to more
        than OUTDATED are given up, with the cloud, to be made anew.
        """
        self._shift += shift
        outdated = [stamp for stamp, start in self._started_at.items() if self._shift - start > OUTDATED]
        if outdated:
            self.retire(outdated)
            self._fusing.submit(self._start_anew)

    def fuse(
        self,
        camera_from_map: Mapping[int, FloatArray],
        camera_from_model: Mapping[int, FloatArray],
        scale: float,
        complete: bool,
        anew: bool,
    ) -> Future[FusedCloud]:
        """The cloud for rigid poses in metres, `scale` metres per unit of the model.

        Of all depth maps if complete, else of those that are there. They are added to the last cloud, unless it is to
        be made anew, the poses have moved by more than a voxel, or much in it is of depth maps that were given up.
        """
        maps = {}
        for stamp, pose in camera_from_map.items():
            future = self._depths.get(stamp)
            if future is not None and (complete or future.done()):
                maps[stamp] = (future, pose)
        return self._fusing.submit(self._fuse, maps, dict(camera_from_model), scale, anew)

    def _beside(self, stamp: int, points: FloatArray, keyframes: Registered) -> int | None:
        """The keyframe before one of a rolling shutter that came for the motion; None for another, or a global one."""
        if not keyframes.motions:
            return None
        before = max((each for each in keyframes.poses if each < stamp and each not in self._between), default=None)
        after = min((each for each in keyframes.poses if each > stamp), default=None)
        if before is None or after is None:
            return None
        return before if is_shown_beside(points, keyframes.view(before), keyframes.view(after)) else None

    def _consider(self, stamp: int, keyframes: Registered) -> None:
        points = keyframes.in_front(stamp)
        if len(points) < MIN_POINTS:
            self._refused[stamp] = len(keyframes)
            return
        before = self._beside(stamp, points, keyframes)
        if before is not None:
            self._between.add(stamp)
            self._cover(stamp, before)
            return
        mapped = [other for other in self._depths if other in keyframes]
        seen = view_overlap(sample(points), keyframes.poses[stamp], [keyframes.view(other) for other in mapped])
        if len(seen) and seen.max() > self._overlap:
            self._cover(stamp, mapped[int(seen.argmax())])
            return
        self._start(stamp, keyframes, points)

    def _cover(self, stamp: int, other: int) -> None:
        """Leaves what a keyframe shows to another one, but for its margins."""
        self._covered[stamp] = other
        self._unsettled.append(stamp)

    def _settle(self, keyframes: Registered, newest: int, complete: bool) -> None:
        """Starts depth maps of covered keyframes that show, at a margin, what too few others show.

        That is known once the walk has left behind what they show, or is complete. `newest`: stamp of the keyframe that
        those considered have waited for; a later one may yet get a depth map that shows the margin.
        """
        while self._unsettled:
            stamp = self._unsettled[0]
            if stamp in self._covered and stamp in keyframes:
                points = keyframes.in_front(stamp)
                own = sample(points)
                if not complete and in_image(own, [keyframes.view(newest)]).mean() > LEFT_BEHIND:
                    return
                mapped = [keyframes.view(other) for other in self._depths if other in keyframes]
                missed = in_image(own, mapped).sum(axis=0) < self._fusion_config.min_views
                if missed.sum() > MARGIN * len(own):
                    del self._covered[stamp]
                    self._between.discard(stamp)
                    self._start(stamp, keyframes, points)
            self._unsettled.popleft()

    def _start(self, stamp: int, keyframes: Registered, points: FloatArray) -> None:
        poses, images = keyframes.poses, keyframes.images
        depth = points @ poses[stamp][2, :3] + poses[stamp][2, 3]
        near, middle, far = np.percentile(depth, [1, 50, 99])
        # The sweep compares images of one size; a camera that switches its resolution has neighbours on either side.
        width = self._stereo_config.width
        size = working_size(images[stamp].camera, width)
        alike = {other: one for other, one in poses.items() if working_size(images[other].camera, width) == size}
        pairs = choose_pairs(stamp, alike, float(middle), self._stereo_config)
        if not pairs:
            self._refused[stamp] = len(keyframes)
            return
        # Surfaces without features lie beyond the sparse points' range as often as not.
        depth_range = (0.7 * float(near), 1.5 * float(far))
        views = [
            _Source(other, images[other], poses[other], _motion(keyframes.motions, other)) for other in [stamp, *pairs]
        ]
        self._depths[stamp] = self._stereo.submit(self._depth, views, depth_range)
        self._started_at[stamp] = self._shift

    def _depth(self, views: list[_Source], depth_range: tuple[float, float]) -> _Depth:
        width = self._stereo_config.width
        images = [
            StereoImage(view.stamp, self._picture(view.image, width), view.pose, view.rolled(width)) for view in views
        ]
        reference, neighbours = images[0], images[1:]
        result = depth_map(reference, neighbours, depth_range)
        pose = reference.camera_from_world
        return _Depth(result, {other.stamp: distance(pose, other.camera_from_world) for other in neighbours})

    def _start_anew(self) -> None:
        self._fusion, self._fused = Fusion(self._fusion_config), {}

    def _fuse(
        self,
        maps: Mapping[int, tuple[Future[_Depth], FloatArray]],
        camera_from_model: Mapping[int, FloatArray],
        scale: float,
        anew: bool,
    ) -> FusedCloud:
        poses = {stamp: pose for stamp, (_, pose) in maps.items()}
        moved = [distance(poses[stamp], pose) for stamp, pose in self._fused.items() if stamp in poses]
        given_up = len(self._fused) - len(moved)
        if anew or given_up > GIVEN_UP * len(maps) or max(moved, default=0.0) > self._fusion_config.voxel:
            self._start_anew()
        for stamp, (future, pose) in maps.items():
            if stamp in self._fused or future.cancelled():  # given up since
                continue
            depth = future.result()
            left = [other for other in depth.baselines if other in camera_from_model]
            if not left:
                continue
            # The model's unit drifts with every adjustment; the baselines tell by how much.
            now = sum(distance(camera_from_model[stamp], camera_from_model[other]) for other in left)
            drift = now / sum(depth.baselines[other] for other in left)
            self._fusion.add(depth.map, pose, scale * drift)
            self._fused[stamp] = pose
        return self._fusion.cloud()


def distance(camera_from_world: FloatArray, other_from_world: FloatArray) -> float:
    """Between the projection centres of two (4, 4) poses."""
    return float(np.linalg.norm(centre(camera_from_world) - centre(other_from_world)))


def centre(camera_from_world: FloatArray) -> FloatArray:
    """(3,) projection centre of a (4, 4) pose."""
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def _picture(image: EncodedImage, width: int) -> Picture:
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None  # the mapper has read it
    undistorted = image.camera.undistort_image(pixels.astype(np.uint8, copy=False))
    return Picture.reduced(undistorted, image.camera.pinhole(), width)


def _motion(motions: Mapping[int, RowMotion], stamp: int) -> RowMotion | None:
    """That of a keyframe, still where it is unknown; None without a rolling shutter."""
    return motions.get(stamp, STILL) if motions else None


def _be_nice() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)  # on Linux of this thread and those it starts
