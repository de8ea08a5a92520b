"""Streaming structure from motion: keyframes in, poses and points of one map out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_sfm.colmap import AbsolutePose, absolute_pose, relative_pose
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features import Features, extract
from pipeprog_sfm.loop import bend, shares
from pipeprog_sfm.matching import MatchArray, match, match_guided
from pipeprog_sfm.model import SparseModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

COARSE = 1500  # strongest features that are matched without a prediction: enough for a pose, a seventh of the cost
POSE_ERROR = 4.0  # px, for RANSAC: the map's points move by a pixel or two before they are adjusted
MIN_INLIERS = 20  # of a pose: far above what chance gives at this error
START_POINTS = 40  # of a new model
START_ANGLE = np.radians(3.0)  # median between the rays of its points
GUIDED_RADIUS = 4.0  # px around the epipolar segment
TEMPORAL = 3  # neighbours in time that every keyframe is matched with
COVISIBLE = 5  # further views by predicted overlap
SAMPLE = 50  # points that tell the overlap with every other view, to a fifteenth
DEPTH_TOLERANCE = 0.05  # of a point's depth in two models: its noise at the smallest angle
LOCAL_WINDOW = 8  # views that local bundle adjustment moves
GROWTH = 1.3  # in views, between two global adjustments
MIN_SHARE = 0.25  # of the matches with the neighbours that a pose must agree with
RIVAL = 0.5  # of a pose's inliers: as many that agree on another pose make it ambiguous, as repeated texture does
RETRIEVED = 6  # views of a model that a lost keyframe is compared with, others each time: the cost stays bounded
ALIKE = 3  # of these that are matched in full
GLANCE = 400  # features that such a comparison takes
GLANCED = MIN_INLIERS * GLANCE // COARSE  # matches of so few features that make a full comparison worth while
LOOKOUT = 4  # keyframes from one look for a loop to the next: known ground stays in view for longer
MAX_DRIFT = 0.05  # of the way since: what exceeds it is no drift but another place that looks alike
RETRIES = 3  # waiting keyframes tried again with each new one
START_CANDIDATES = 8  # waiting keyframes that a new one may start a model with
REMEMBERED = 100  # retired keyframes whose features are kept for when they are called for again: 60 MB
PAIRS_REMEMBERED = 2000  # of keyframes, whose matches are kept: 10 MB
ERROR_SAMPLE = 20_000  # observations whose mean error is told: a hundredth of a pixel exact
GRID = (32, 18)
NO_STAMP = -1


@dataclass(frozen=True)
class KeyframeReport:
    """What became of a keyframe: inliers of its pose, mean reprojection error in px; reason when not registered."""

    stamp: int
    registered: bool
    reason: str
    inliers: int
    reprojection_error: float


@dataclass(frozen=True)
class FrameTie:
    """Overlap of a keyframe with the map: Eq. 1 of the paper (hull areas) and the share of 32 x 18 cells."""

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    tie_points: int
    features: int
    matches_previous: int
    matches_next: int


@dataclass(frozen=True)
class _Keyframe:
    stamp: int
    features: Features
    camera: Camera
    rays: FloatArray
    focal: FloatArray
    hull: float  # of its features, px^2
    cells: int  # of the grid that hold a feature


@dataclass(frozen=True)
class _Location:
    """A keyframe's pose in a model (None: the reason says why), its (feature, point) pairs, matches by stamp."""

    camera_from_model: FloatArray | None
    pairs: IntArray
    evidence: dict[int, MatchArray]
    reason: str


class Mapper:
    """Registers each keyframe as it comes; the published model is the chosen one, else the largest."""

    def __init__(self, config: MapperConfig, seed: int = 0) -> None:
        self._config = config
        self._seed = seed
        self._keyframes: dict[int, _Keyframe] = {}
        self._waiting: list[int] = []
        self._models: list[SparseModel] = []
        self._evidence: dict[int, dict[int, MatchArray]] = {}
        self._chosen: int | None = None
        self._revision = 0
        self._cursor = 0
        self._tied: dict[int, tuple[int | None, int, int | None]] = {}
        self._retired: dict[int, _Keyframe] = {}
        self._matches: dict[tuple[int, int, int | None], MatchArray] = {}

    @property
    def seen(self) -> int:
        """Keyframes given so far, less those retired."""
        return len(self._keyframes)

    @property
    def registered(self) -> int:
        """Keyframes of the published model."""
        return len(self._published) if self._models else 0

    @property
    def waiting(self) -> int:
        """Keyframes without a pose."""
        return len(self._waiting)

    @property
    def models(self) -> int:
        """Unconnected models."""
        return len(self._models)

    @property
    def revision(self) -> int:
        """Grows whenever poses of earlier keyframes may have moved as a whole."""
        return self._revision

    @property
    def reprojection_error(self) -> float:
        """Mean over the published model's observations, px; 0 without a model."""
        if not self._models:
            return 0.0
        model = self._published
        features = np.flatnonzero(model.point_of >= 0)
        features = features[:: max(len(features) // ERROR_SAMPLE, 1)]
        return float(model.errors(features).mean()) if len(features) else 0.0

    @property
    def _published(self) -> SparseModel:
        chosen = None if self._chosen is None else self._model_of(self._chosen)
        return chosen or max(self._models, key=len)

    def add(self, stamp: int, gray: NDArray[np.uint8], camera: Camera) -> KeyframeReport:
        """Takes a keyframe: (H, W) uint8 as the camera saw it, stamp in ns. One that was retired is known already."""
        known = self._retired.pop(stamp, None)
        return self._add(known or _keyframe(stamp, extract(gray, camera, self._config), camera))

    def add_features(self, stamp: int, features: Features, camera: Camera) -> KeyframeReport:
        """Takes a keyframe whose features are known."""
        return self._add(_keyframe(stamp, features, camera))

    def _add(self, keyframe: _Keyframe) -> KeyframeReport:
        stamp = keyframe.stamp
        self._keyframes[stamp] = keyframe
        report = self._register_anywhere(keyframe)
        if not report.registered:
            self._waiting.append(stamp)
            if not self._start(keyframe):
                return report
        self._retry(stamp)
        self._close(stamp)
        if len(self._models) > 1:
            self._merge(stamp)
        return self._report(stamp)

    def exchange(self, stamp: int, features: Features) -> bool:
        """Gives a keyframe other features, and a pose by them, where more of them agree with what its neighbours see.

        Returns whether it has; else all stays as it was.
        """
        known = self._keyframes[stamp]
        other = _keyframe(stamp, features, known.camera)
        model = self._model_of(stamp) or min(self._models, key=lambda model: _distance(model, stamp), default=None)
        if model is None or len(model) < 3:
            return False
        agreeing = []
        for keyframe in (known, other):
            self._forget_matches(stamp)
            agreeing.append(len(self._locate(model, keyframe, _neighbours(model, stamp), None).pairs))
        if agreeing[1] <= agreeing[0]:
            self._forget_matches(stamp)
            return False
        if stamp in model.stamps:
            self._drop(model, model.stamps.index(stamp))
        else:
            self._waiting.remove(stamp)
        for evidence in self._evidence.values():
            evidence.pop(stamp, None)
        for keyframe in (other, known):
            self._keyframes[stamp] = keyframe
            if self._register(model, keyframe, _neighbours(model, stamp), None).registered:
                return keyframe is other
            self._forget_matches(stamp)
        self._waiting.append(stamp)
        return False

    def retire(self, stamps: Collection[int]) -> None:
        """Takes keyframes out of the map: pose and observations; unknown stamps are ignored.

        The features and matches of the last ones are kept for when they come again.
        A point that fewer than two others see goes with them. A view that is left alone in its model waits again.
        """
        for stamp in stamps:
            keyframe = self._keyframes.pop(stamp, None)
            if keyframe is None:
                continue
            self._retired[stamp] = keyframe
            _forget_oldest(self._retired, REMEMBERED)
            self._tied.pop(stamp, None)
            model = self._model_of(stamp)
            if model is None:
                self._waiting.remove(stamp)
            else:
                self._drop(model, model.stamps.index(stamp))
        for model in list(self._models):
            if len(model) < 2:
                self._waiting += model.stamps
                self._models.remove(model)
                self._revision += 1
            elif stamps:
                model.filter(*model.observations(np.ones(len(model.points), bool)))

    def finish(self) -> None:
        """Tries the waiting keyframes once more and adjusts everything."""
        for model in self._models:
            self._adjust_globally(model)
        while self._waiting:
            before = len(self._waiting)
            for stamp in list(self._waiting):
                if self._register_anywhere(self._keyframes[stamp]).registered:
                    self._waiting.remove(stamp)
            if len(self._waiting) >= before:
                break
        for stamp in [stamp for model in sorted(self._models, key=len)[:-1] for stamp in model.stamps]:
            self._merge(stamp)
        for model in self._models:
            self._adjust_globally(model)

    def camera_from_model(self) -> dict[int, FloatArray]:
        """Poses (4, 4) of the published model's keyframes, in order of time."""
        return _poses(self._published) if self._models else {}

    def pieces(self) -> list[dict[int, FloatArray]]:
        """Poses (4, 4) camera_from_model by stamp of all models, the largest one first."""
        return [_poses(model) for model in sorted(self._models, key=len, reverse=True)]

    def covariance(self, stamp: int, gradients: FloatArray) -> FloatArray:
        """(S, S) covariance of functions of the poses of the model that holds a keyframe.

        gradients (S, N, 6): derivatives by each of its poses, in order of time; see `function_covariance`.
        """
        model = self._model_of(stamp)
        assert model is not None
        return model.covariance(gradients[:, np.argsort(np.argsort(model.stamps, kind="stable"))])

    def publish(self, stamp: int) -> None:
        """Chooses the model that holds a keyframe, and what it will be merged with, for publication."""
        self._chosen = stamp

    def points_seen(self, stamp: int) -> FloatArray:
        """(K, 3) points in the model that a keyframe of the published model sees."""
        model = self._published
        own = model.point_of[model.features(model.stamps.index(stamp))]
        return model.points[own[own >= 0]]

    def points(self, stamp: int) -> FloatArray:
        """(P, 3) points of the model that holds a keyframe."""
        model = self._model_of(stamp)
        assert model is not None
        return model.points[np.unique(model.point_of[model.point_of >= 0])]

    def observations(self) -> tuple[FloatArray, dict[int, tuple[IntArray, FloatArray]]]:
        """(P, 3) points of the published model, and what each keyframe sees of them.

        By stamp: (K,) rows of the points and (K, 2) pixels of the ideal pinhole image.
        """
        model = self._published
        ids = np.unique(model.point_of[model.point_of >= 0])
        row = np.full(len(model.points), -1)
        row[ids] = np.arange(len(ids))
        seen = {}
        for view in np.argsort(model.stamps, kind="stable"):
            stamp = model.stamps[view]
            own = model.point_of[model.features(view)]
            pixels = self._keyframes[stamp].features.keypoints[own >= 0].astype(np.float64)
            seen[stamp] = row[own[own >= 0]], pixels
        return model.points[ids], seen

    def ties(self) -> list[FrameTie]:
        """Overlap of the keyframes for which it changed since the last call."""
        model = self._published if self._models else SparseModel()
        view_of = {stamp: view for view, stamp in enumerate(model.stamps)}
        stamps = sorted(self._keyframes)
        tied = {stamp: model.features(view) for stamp, view in view_of.items()}
        digests = model.digests().tolist()
        marks = {stamp: digests[view_of[stamp]] if stamp in view_of else 0 for stamp in stamps}
        changed = []
        for before, stamp, after in zip([NO_STAMP, *stamps[:-1]], stamps, [*stamps[1:], NO_STAMP], strict=True):
            mark = (marks.get(before), marks[stamp], marks.get(after))
            if self._tied.get(stamp) != mark:
                self._tied[stamp] = mark
                near = (model.point_of[tied[one]] if one in tied else None for one in (before, stamp, after))
                changed.append(self._tie(stamp, *near))
        return changed

    def _tie(self, stamp: int, before: IntArray | None, own: IntArray | None, after: IntArray | None) -> FrameTie:
        keyframe = self._keyframes[stamp]
        keypoints = keyframe.features.keypoints
        inside = keypoints[:0] if own is None else keypoints[own >= 0]
        size = keyframe.camera.width, keyframe.camera.height
        return FrameTie(
            stamp,
            own is not None,
            _hull(inside) / max(keyframe.hull, 1e-9),
            _cells(inside, size) / max(keyframe.cells, 1),
            len(inside),
            len(keypoints),
            _common(before, own),
            _common(own, after),
        )

    def _model_of(self, stamp: int) -> SparseModel | None:
        return next((model for model in self._models if stamp in model.stamps), None)

    def _report(self, stamp: int) -> KeyframeReport:
        model = self._model_of(stamp)
        if model is None:
            return KeyframeReport(stamp, False, "the global adjustment has refused its pose", 0, 0.0)
        own = np.arange(*model.offsets[model.stamps.index(stamp) :][:2])
        own = own[model.point_of[own] >= 0]
        return KeyframeReport(stamp, True, "", len(own), float(model.errors(own).mean()) if len(own) else 0.0)

    def _register_anywhere(self, keyframe: _Keyframe) -> KeyframeReport:
        """By the neighbours in time; failing that, by views that look alike."""
        report = KeyframeReport(keyframe.stamp, False, "no model has been started yet", 0, 0.0)
        for model in sorted(self._models, key=lambda model: _distance(model, keyframe.stamp))[:2]:
            report = self._register(model, keyframe, _neighbours(model, keyframe.stamp), COARSE)
            if report.registered:
                return report
        for model in sorted(self._models, key=len, reverse=True)[:2]:
            alike = self._alike(model, keyframe)
            if len(alike):
                report = self._register(model, keyframe, alike, None)
            if report.registered:
                return report
        return report

    def _alike(self, model: SparseModel, keyframe: _Keyframe) -> IntArray:
        """Views, out of the few that it is the turn of, that share most of the strongest features."""
        return self._resembling(model, keyframe, self._turn(len(model)), 1)

    def _turn(self, count: int) -> IntArray:
        """The few out of `count` that it is the turn of, spread evenly; others each time."""
        chosen = (self._cursor + np.arange(min(RETRIEVED, count)) * max(count // RETRIEVED, 1)) % count
        self._cursor += 1
        return chosen

    def _resembling(self, model: SparseModel, keyframe: _Keyframe, views: IntArray, least: int) -> IntArray:
        """Those views that share most of the strongest features, and at least so many."""
        found = [len(self._matched(keyframe, self._keyframes[model.stamps[view]], GLANCE)) for view in views]
        order = np.argsort(-np.array(found), kind="stable")[:ALIKE]
        return views[order][np.array(found)[order] >= least]

    def _matched(self, keyframe: _Keyframe, other: _Keyframe, count: int | None) -> MatchArray:
        """Matches of the `count` strongest features (None: of all) of two keyframes, found once."""
        pair = keyframe.stamp, other.stamp, count
        if pair not in self._matches:
            self._matches[pair] = match(keyframe.features.descriptors[:count], other.features.descriptors[:count])
            _forget_oldest(self._matches, PAIRS_REMEMBERED)
        return self._matches[pair]

    def _locate(self, model: SparseModel, keyframe: _Keyframe, anchors: IntArray, count: int | None) -> _Location:
        """Pose by the map points that the anchors see, from the `count` strongest features (None: from all)."""
        evidence = {}
        pairs = []
        for view in anchors:
            found = self._matched(keyframe, self._keyframes[model.stamps[view]], count)
            evidence[model.stamps[view]] = found
            pairs.append(np.stack([found[:, 0], model.point_of[model.offsets[view] + found[:, 1]]], axis=1))
        known = np.concatenate(pairs)
        known = np.unique(known[known[:, 1] >= 0], axis=0)
        pose = self._absolute_pose(model, keyframe, known)
        if pose is None or pose.inliers.sum() < MIN_INLIERS:
            agreeing = 0 if pose is None else int(pose.inliers.sum())
            return _Location(None, known[:0], evidence, f"only {agreeing} of {len(known)} matches agree on a pose")
        rest = known[~pose.inliers]
        if len(rest) >= RIVAL * pose.inliers.sum():
            rival = self._absolute_pose(model, keyframe, rest)
            if rival is not None and rival.inliers.sum() >= RIVAL * pose.inliers.sum():
                reason = f"{pose.inliers.sum()} matches agree on a pose and {rival.inliers.sum()} on another one"
                return _Location(None, known[:0], evidence, reason)
        return _Location(pose.camera_from_model, known[pose.inliers], evidence, "")

    def _forget_matches(self, stamp: int) -> None:
        self._matches = {pair: found for pair, found in self._matches.items() if stamp not in pair[:2]}

    def _absolute_pose(self, model: SparseModel, keyframe: _Keyframe, pairs: IntArray) -> AbsolutePose | None:
        pixels, points = keyframe.features.keypoints[pairs[:, 0]], model.points[pairs[:, 1]]
        return absolute_pose(pixels, points, keyframe.camera, POSE_ERROR, self._seed)

    def _register(
        self, model: SparseModel, keyframe: _Keyframe, anchors: IntArray, count: int | None
    ) -> KeyframeReport:
        """Pose, then matches, tracks and local adjustment; taken back when the result is thin or contradictory."""
        location = self._locate(model, keyframe, anchors, count)
        used = location.pairs
        if location.camera_from_model is None:
            return KeyframeReport(keyframe.stamp, False, location.reason, 0, 0.0)
        view = model.add_view(keyframe.stamp, keyframe.rays, keyframe.focal, location.camera_from_model)
        first = np.unique(used[:, 0], return_index=True)[1]
        model.point_of[model.offsets[view] + used[first, 0]] = used[first, 1]
        self._link(model, view)
        self._adjust_locally(model, view)
        self._evidence[keyframe.stamp] = location.evidence
        objection = self._objection(model, view)
        if objection:
            self._drop(model, view)
            return KeyframeReport(keyframe.stamp, False, objection, len(used), 0.0)
        if len(model) >= GROWTH * model.adjusted_at:
            self._adjust_globally(model)
        return KeyframeReport(keyframe.stamp, True, "", len(used), 0.0)

    def _objection(self, model: SparseModel, view: int) -> str:
        """Why a pose cannot be believed: too few points, or matches with the neighbours that contradict it."""
        tied = int((model.point_of[model.features(view)] >= 0).sum())
        if tied < MIN_INLIERS:
            return f"only {tied} points hold its pose"
        errors = [
            model.epipolar_errors(view, model.stamps.index(other), found)
            for other, found in self._evidence.get(model.stamps[view], {}).items()
            if other in model.stamps
        ]
        error = np.concatenate(errors) if errors else np.empty(0)
        share = float((error < POSE_ERROR).mean()) if len(error) else 1.0
        if share < MIN_SHARE:
            return f"only {share:.0%} of the matches with its neighbours agree with its pose"
        return ""

    def _drop(self, model: SparseModel, view: int) -> None:
        self._evidence.pop(model.stamps[view], None)  # the two that started the model have none
        model.drop(view)

    def _link(self, model: SparseModel, view: int) -> None:
        """Matches a view with its neighbours in time and with those that look at the same place, by the poses."""
        own = model.point_of[model.features(view)]
        depth = model.points[own[own >= 0]] @ model.rotation[view, 2] + model.translation[view, 2]
        depth = depth[depth > 0]
        if not len(depth):
            return
        near, far = 0.5 * np.percentile(depth, 2), 2.0 * np.percentile(depth, 98)
        features, others = [], []
        for other in self._partners(model, view, own[own >= 0]):
            found = self._match_guided(model, view, other, float(near), float(far))
            features.append(found[:, 0] + model.offsets[view])
            others.append(found[:, 1] + model.offsets[other])
        if not features:
            return
        feature, other_feature = np.concatenate(features).astype(np.int64), np.concatenate(others).astype(np.int64)
        order = np.lexsort((other_feature, feature))
        model.link(feature[order], other_feature[order])

    def _partners(self, model: SparseModel, view: int, seen: IntArray) -> list[int]:
        """Neighbours in time, then the views into which most of the view's points project from a like direction."""
        gap = np.abs(np.array(model.stamps) - model.stamps[view])
        gap[view] = np.iinfo(np.int64).max
        temporal = [int(other) for other in np.argsort(gap, kind="stable")[:TEMPORAL] if other != view]
        sample = model.points[seen[:: max(len(seen) // SAMPLE, 1)]]
        # One product of matrices, coordinate by coordinate: this is all that looks at every view of the map.
        inside = (model.rotation.reshape(-1, 3) @ sample.T).reshape(len(model), 3, -1) + model.translation[..., None]
        depth = inside[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = inside[:, 0] / depth, inside[:, 1] / depth
        camera = self._keyframes[model.stamps[view]].camera
        visible = (depth > 0) & (np.abs(u) < 0.5 * camera.width / camera.fx)
        visible &= np.abs(v) < 0.5 * camera.height / camera.fy
        # SIFT finds a patch again when it is seen from within some 40 degrees and at up to twice the scale.
        own = depth[view]
        visible &= (depth < 2 * own) & (2 * depth > own)
        alike = model.rotation[:, 2] @ model.rotation[view, 2] > np.cos(np.radians(40))
        score = np.where(alike, visible.mean(axis=1), 0.0)
        score[[view, *temporal]] = 0.0
        best = np.argsort(-score, kind="stable")[:COVISIBLE]
        return temporal + [int(other) for other in best if score[other] > 0.3]

    def _match_guided(self, model: SparseModel, view: int, other: int, near: float, far: float) -> MatchArray:
        """Matches along the epipolar segment between two depths; a feature with a point is looked for at its place."""
        mine = self._keyframes[model.stamps[view]]
        theirs = self._keyframes[model.stamps[other]]
        rotation = model.rotation[other] @ model.rotation[view].T
        translation = model.translation[other] - rotation @ model.translation[view]
        low = np.full(len(mine.rays), near)
        high = np.full(len(mine.rays), far)
        own = model.point_of[model.features(view)]
        has = own >= 0
        depth = model.points[own[has]] @ model.rotation[view, 2] + model.translation[view, 2]
        low[has], high[has] = 0.95 * depth, 1.05 * depth
        direction = np.c_[mine.rays, np.ones(len(mine.rays))] @ rotation.T
        focal, centre = theirs.focal, np.array([theirs.camera.cx, theirs.camera.cy])
        ends = []
        for distance in (low, high):
            inside = direction * distance[:, None] + translation
            pixel = np.full((len(inside), 2), np.nan)
            front = inside[:, 2] > 0.1 * distance
            pixel[front] = inside[front, :2] / inside[front, 2:] * focal + centre
            ends.append(pixel)
        return match_guided(
            mine.features.descriptors, ends[0], ends[1],
            theirs.features.descriptors, theirs.features.keypoints, GUIDED_RADIUS,
        )  # fmt: skip

    def _start(self, keyframe: _Keyframe) -> bool:
        """Starts a model from the new keyframe and the waiting one with which most points can be triangulated."""
        best: SparseModel | None = None
        for stamp in self._waiting[-START_CANDIDATES - 1 : -1]:
            model = self._pair(self._keyframes[stamp], keyframe)
            if model is not None and (best is None or _tracks(model) > _tracks(best)):
                best = model
        if best is None:
            return False
        self._models.append(best)
        self._revision += 1
        self._waiting = [stamp for stamp in self._waiting if stamp not in best.stamps]
        return True

    def _pair(self, first: _Keyframe, second: _Keyframe) -> SparseModel | None:
        found = self._matched(first, second, COARSE)
        if len(found) < START_POINTS:
            return None
        pixels, other_pixels = first.features.keypoints[found[:, 0]], second.features.keypoints[found[:, 1]]
        pose = relative_pose(pixels, other_pixels, first.camera, second.camera, 0.5 * POSE_ERROR, self._seed)
        if pose is None or pose.inliers.sum() < START_POINTS:
            return None
        model = SparseModel()
        model.add_view(first.stamp, first.rays, first.focal, np.eye(4))
        view = model.add_view(second.stamp, second.rays, second.focal, pose.b_from_a)
        pairs = found[pose.inliers].astype(np.int64)
        pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
        model.link(pairs[:, 1] + model.offsets[view], pairs[:, 0])
        model.adjust(None, 20, 1e-4)
        self._link(model, view)
        model.adjust(None, 20, 1e-4)
        ids, _, _ = model.observations(np.ones(len(model.points), bool))
        if len(ids) < START_POINTS:
            return None
        rays = model.points[ids, None] - model.centres()[None]
        cosine = (rays[:, 0] * rays[:, 1]).sum(axis=1) / np.linalg.norm(rays, axis=2).prod(axis=1)
        angle = np.median(np.arccos(np.clip(cosine, -1, 1)))
        return model if angle > START_ANGLE else None

    def _retry(self, stamp: int) -> None:
        """Tries the waiting keyframes nearest in time to a registered one."""
        for waiting in sorted(self._waiting, key=lambda other: abs(other - stamp))[:RETRIES]:
            if self._register_anywhere(self._keyframes[waiting]).registered:
                self._waiting.remove(waiting)

    def _merge(self, stamp: int) -> None:
        """Joins the keyframe's model with another one in which the keyframe can be located as well."""
        own = self._model_of(stamp)
        if own is None:
            return
        keyframe = self._keyframes[stamp]
        for other in [model for model in self._models if model is not own]:
            alike = self._alike(other, keyframe)
            if not len(alike):
                continue
            location = self._locate(other, keyframe, alike, None)
            if location.camera_from_model is None:
                continue
            relation = _relation(own, own.stamps.index(stamp), other, location)
            if relation is None:
                continue
            scale, other_from_own = relation
            self._join(own, other, scale, other_from_own, stamp)
            return

    def _close(self, stamp: int) -> None:
        """Closes a loop: where the keyframe is back at known ground that its points are not tied to, these are one.

        A keyframe that already shares points with views of long ago is where it seems to be.
        """
        model = self._model_of(stamp)
        if model is None:
            return
        view = model.stamps.index(stamp)
        if view % LOOKOUT:
            return
        rank = np.argsort(np.argsort(model.stamps))
        old = np.abs(rank - rank[view]) > 2 * LOCAL_WINDOW
        if not old.any() or (model.covisible(view)[old] >= MIN_INLIERS).any():
            return
        keyframe, known = self._keyframes[stamp], np.flatnonzero(old)
        own = model.point_of[model.features(view)]
        near = [other for other in self._partners(model, view, own[own >= 0]) if old[other]]
        views = np.unique(np.r_[np.array(near, np.int64), known[self._turn(len(known))]])
        alike = self._resembling(model, keyframe, views, GLANCED)
        if not len(alike):
            return
        location = self._locate(model, keyframe, alike, None)
        relation = None if location.camera_from_model is None else _relation(model, view, model, location)
        if relation is None:
            return
        scale, correction = relation
        order = np.argsort(model.stamps)
        between = order[min(rank[view], rank[alike[0]]) : max(rank[view], rank[alike[0]]) + 1]
        way = np.linalg.norm(np.diff(model.centres()[between], axis=0), axis=1).sum()
        centre = model.centre(view)
        drift = np.linalg.norm(correction[:3, :3] @ centre * scale + correction[:3, 3] - centre)
        if drift > MAX_DRIFT * way:
            return
        bend(model, shares(model, alike, view), scale, correction)
        for other in order[max(rank[view] - LOCAL_WINDOW, 0) : rank[view] + LOCAL_WINDOW]:
            self._link(model, int(other))
        self._adjust_globally(model)

    def _join(
        self, source: SparseModel, target: SparseModel, scale: float, target_from_source: FloatArray, stamp: int
    ) -> None:
        if len(source) > len(target):
            source, target = target, source
            scale = 1 / scale
            target_from_source = np.linalg.inv(target_from_source) @ np.eye(4)
            target_from_source[:3, 3] *= scale
        target.absorb(source, scale, target_from_source)
        self._models = [model for model in self._models if model is not source]
        # The seam is tight where the keyframe saw both, and is sewn up from there.
        for view in sorted(range(len(target)), key=lambda view: abs(target.stamps[view] - stamp))[: 2 * LOCAL_WINDOW]:
            self._link(target, view)
        self._adjust_globally(target)
        for other in source.stamps:
            if other in target.stamps:
                self._link(target, target.stamps.index(other))
        self._adjust_globally(target)

    def _adjust_locally(self, model: SparseModel, view: int) -> None:
        shared = model.covisible(view)
        window = np.argsort(-shared, kind="stable")[: LOCAL_WINDOW - 1]
        window = np.append(window[shared[window] > 0], view)
        if len(model) <= LOCAL_WINDOW:
            model.adjust(None, 10, 1e-3)
        else:
            model.adjust(window, 10, 1e-3)

    def _adjust_globally(self, model: SparseModel) -> None:
        """Adjusts all views, and sends those back to wait whose poses turn out wrong."""
        model.adjust(None, 10, 1e-3)
        for view in reversed(range(len(model))):
            if len(model) > 2 and self._objection(model, view):
                self._waiting.append(model.stamps[view])
                self._drop(model, view)
        model.adjusted_at = len(model)
        self._revision += 1


def _keyframe(stamp: int, features: Features, camera: Camera) -> _Keyframe:
    rays = (features.keypoints - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    hull, cells = _hull(features.keypoints), _cells(features.keypoints, (camera.width, camera.height))
    return _Keyframe(stamp, features, camera, rays, np.array([camera.fx, camera.fy]), hull, cells)


def _forget_oldest(known: dict[Any, Any], limit: int) -> None:
    while len(known) > limit:
        del known[next(iter(known))]


def _relation(
    source: SparseModel, view: int, target: SparseModel, location: _Location
) -> tuple[float, FloatArray] | None:
    """Scale and rigid target_from_source (4, 4) by a view of the source that was located in the target.

    None where the depths of the points that both see through this view do not agree.
    """
    used = location.pairs
    mine = source.point_of[source.offsets[view] + used[:, 0]]
    used, mine = used[mine >= 0], mine[mine >= 0]
    own_pose, pose = source.pose(view), location.camera_from_model
    assert pose is not None
    depth = source.points[mine] @ own_pose[2, :3] + own_pose[2, 3]
    ratio = (target.points[used[:, 1]] @ pose[2, :3] + pose[2, 3]) / depth
    scale = float(np.median(ratio)) if len(ratio) else 0.0
    if scale <= 0 or (np.abs(ratio / scale - 1) < DEPTH_TOLERANCE).sum() < MIN_INLIERS:
        return None
    own_pose[:3, 3] *= scale
    return scale, np.linalg.inv(pose) @ own_pose


def _poses(model: SparseModel) -> dict[int, FloatArray]:
    poses = np.tile(np.eye(4), (len(model), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = model.rotation, model.translation
    order = np.argsort(model.stamps, kind="stable")
    return dict(zip(np.array(model.stamps)[order].tolist(), poses[order], strict=True))


def _tracks(model: SparseModel) -> int:
    return int((model.point_of >= 0).sum())


def _distance(model: SparseModel, stamp: int) -> int:
    """Time to the model's nearest view, ns."""
    return min(abs(other - stamp) for other in model.stamps)


def _neighbours(model: SparseModel, stamp: int) -> IntArray:
    """The two views nearest in time, without the keyframe itself."""
    gap = np.abs(np.array(model.stamps) - stamp)
    return np.array([view for view in np.argsort(gap, kind="stable")[:3] if gap[view]][:2], np.int64)


def _common(points: IntArray | None, others: IntArray | None) -> int:
    """Points that two views both see."""
    if points is None or others is None:
        return 0
    return len(np.intersect1d(points[points >= 0], others[others >= 0]))


def _hull(pixels: NDArray[np.float32]) -> float:
    """Area of the convex hull of (N, 2) pixels."""
    return float(cv2.contourArea(cv2.convexHull(pixels))) if len(pixels) > 2 else 0.0


def _cells(pixels: NDArray[np.float32], size: tuple[int, int]) -> int:
    """Cells of a grid over the image that hold a pixel."""
    column = (pixels[:, 0] * GRID[0] / size[0]).astype(int)
    row = (pixels[:, 1] * GRID[1] / size[1]).astype(int)
    return len(np.unique(row * GRID[0] + column))
