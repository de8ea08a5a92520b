# SPDX-License-Identifier: Apache-2.0
"""Streaming structure from motion: keyframes in, poses and points of one map out."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import IntArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.retrieval import COARSE, Retrieval
from pipeprog_sfm.features.sift import Features, extract
from pipeprog_sfm.model.row_motion import predicted_motion, row_motions, told_by_rows, unroll, unrolled_by
from pipeprog_sfm.model.self_calibration import (
    EARLY_POINTS,
    MAX_POINTS,
    TOLERATED_SHIFT,
    Priors,
    Refinement,
    refine,
)
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.localizer import Localizer
from pipeprog_sfm.sparse.loop_closure import close_loop
from pipeprog_sfm.sparse.model_merging import merge_models
from pipeprog_sfm.sparse.registration import add_view, doubtful_views, rejection_reason
from pipeprog_sfm.sparse.sparse_map import MAX_TURNS, SparseMap
from pipeprog_sfm.sparse.two_view import model_from_pair

GROWTH = 1.3  # in views, between two global adjustments: their cost stays a constant share of the whole
RETRIES = 3  # waiting keyframes tried again with each new one: a constant cost, and the nearest in time fit best
# Waiting keyframes of each camera that a new one may start a model with: a baseline grows within a second or two.
START_CANDIDATES = 8
REMEMBERED = 100  # retired keyframes whose features are kept in case they are added again: 60 MB


@dataclass(frozen=True)
class KeyframeReport:
    """What became of a keyframe: inliers of its pose, mean reprojection error in px; reason when not registered."""

    stamp: int
    registered: bool
    reason: str
    inliers: int
    reprojection_error: float


class Mapper:
    """Registers each keyframe in `map` as it comes.

    `extract_features` and `remembered` are given by tests only.
    """

    def __init__(
        self,
        config: MapperConfig,
        seed: int = 0,
        *,
        extract_features: Callable[[NDArray[np.uint8], Camera, MapperConfig], Features] = extract,
        retrieval: Retrieval | None = None,
        remembered: int = REMEMBERED,
        readout: float = 0.0,
    ) -> None:
        self.map = SparseMap(readout)
        self._config, self._seed = config, seed
        self._extract, self._remembered = extract_features, remembered
        self._retrieval = retrieval or Retrieval()
        self._localizer = Localizer(self.map.keyframes, self._retrieval, seed)
        self._retired: dict[int, Keyframe] = {}

    def add(
        self,
        stamp: int,
        gray: NDArray[np.uint8],
        camera: Camera,
        frame: str = "",
        features: Features | None = None,
    ) -> KeyframeReport:
        """Takes a keyframe; features of a retired one are reused.

        Args:
            stamp: of the keyframe [ns].
            gray: (H, W) uint8 image as the camera saw it.
            camera: calibration.
            frame: name of the camera's optical frame.
            features: of the image, where they have been extracted already.
        """
        known = self._retired.pop(stamp, None)
        if known is not None:
            features = known.measured_features()
        if features is None:
            features = self._extract(gray, camera, self._config)
        return self.add_features(stamp, features, camera, frame)

    def add_features(self, stamp: int, features: Features, camera: Camera, frame: str = "") -> KeyframeReport:
        """Takes a keyframe whose features are known; frame: of its camera."""
        keyframe = Keyframe.of(stamp, features, camera, frame)
        self.map.keyframes[stamp] = keyframe
        report = self._register_anywhere(keyframe)
        if not report.registered:
            self.map.waiting.append(stamp)
            if not self._start_model(keyframe):
                return report
        self._retry_near(stamp)
        close_loop(self.map, self._localizer, stamp)
        if len(self.map.models) > 1:
            self._retry_from(stamp, merge_models(self.map, self._localizer, stamp))
        return self._report(stamp)

    def replace_features(self, stamp: int, features: Features) -> bool:
        """Gives a keyframe other features, and a pose by them, if more of them agree with what its neighbours see.

        Returns whether it has; else all stays as it was.
        """
        known = self.map.keyframes[stamp]
        other = Keyframe.of(stamp, features, known.camera, known.frame)
        model = self.map.model_of(stamp) or min(self.map.models, key=lambda model: _gap(model, stamp), default=None)
        if model is None or len(model) < 3:
            return False
        inliers = []
        for keyframe in (known, other):
            self._retrieval.forget(stamp)
            inliers.append(len(self._localizer.locate_by(model, keyframe, self._neighbours(model, keyframe)).pairs))
        if inliers[1] <= inliers[0]:
            self._retrieval.forget(stamp)
            return False
        if stamp in model.stamps:
            self.map.remove_view(model, model.stamps.index(stamp))
        else:
            self.map.waiting.remove(stamp)
        for matches in self.map.matches.values():
            matches.pop(stamp, None)
        for keyframe in (other, known):
            self.map.keyframes[stamp] = keyframe
            if self._register(model, keyframe, self._neighbours(model, keyframe), None).registered:
                return keyframe is other
            self._retrieval.forget(stamp)
        self.map.waiting.append(stamp)
        return False

    def retire(self, stamps: Collection[int]) -> None:
        """Takes keyframes out of the map; the features and matches of the last ones are kept for `add`."""
        for keyframe in self.map.retire(stamps):
            self._retired[keyframe.stamp] = keyframe
            if len(self._retired) > self._remembered:
                del self._retired[next(iter(self._retired))]

    def self_calibration(self, told: Priors, final: bool) -> Refinement | None:
        """The camera that the published model agrees with best; None where that is not known, or of several cameras.

        final: for the final map, by more points, unless it is of a rolling shutter: there, errors of the velocities are
        larger than those of few points.
        """
        model, keyframes, motions = self.map.published, self.map.keyframes, {}
        if len({keyframes[stamp].camera for stamp in model.stamps}) != 1:
            return None
        if told.sigmas[3] > 0:
            moving = row_motions(model, keyframes, self.map.readout)
            motions = {stamp: motion for stamp, motion in moving.by_spline.items() if stamp not in moving.decided}
            if self.map.readout and moving.by_spline:
                model, keyframes = copy.deepcopy(model), dict(keyframes)
                unroll(model, keyframes, moving.of_all(rows_correct=False))
        return refine(model, keyframes, told, motions, MAX_POINTS if final and not self.map.readout else EARLY_POINTS)

    def keeps_map(self, refinement: Refinement) -> bool:
        """Whether the map stays with a refined camera: another read-out moves each feature by less than 1 px."""
        is_rolling = self.map.readout > 0.0 and refinement.readout > 0.0
        return is_rolling and refinement.camera == refinement.told and refinement.shift < TOLERATED_SHIFT

    def take_camera(self, refinement: Refinement, final: bool) -> None:
        """Goes on with a refined camera; final: `finish` comes next.

        Where the map does not stay (`keeps_map`), it grows again, from the features of its keyframes: matches that
        another camera had rejected would stay out. Features and most matches are there: it takes seconds.
        """
        told, camera = refinement.told, refinement.camera
        if self.keeps_map(refinement):
            self.map.readout = refinement.readout
            for model in [] if final else list(self.map.models):
                self.map.adjust_globally(model, by_spline=MAX_TURNS)
            return
        for stamp, keyframe in self._retired.items():
            self._retired[stamp] = _with_camera(keyframe, told, camera)
        keyframes = [_with_camera(keyframe, told, camera) for keyframe in self.map.keyframes.values()]
        self.map.clear()
        self.map.readout = refinement.readout
        for keyframe in keyframes:
            self.add_features(keyframe.stamp, keyframe.measured_features(), keyframe.camera, keyframe.frame)

    def finish(self) -> None:
        """Tries the waiting keyframes once more and adjusts everything."""
        adjusted = []
        for model in self.map.models:
            self.map.adjust_globally(model, MAX_TURNS, MAX_TURNS)
            adjusted.append(list(model.stamps))
            for view in reversed(doubtful_views(model, self.map.keyframes) if self.map.readout else []):
                if len(model) > 2:
                    self.map.put_back(model, view)
        while self.map.waiting:
            before = len(self.map.waiting)
            self._retry(list(self.map.waiting))
            if len(self.map.waiting) >= before:
                break
        for stamp in [stamp for model in sorted(self.map.models, key=len)[:-1] for stamp in model.stamps]:
            self._retry_from(stamp, merge_models(self.map, self._localizer, stamp))
        for model in self.map.models:
            if model.stamps not in adjusted:
                self.map.adjust_globally(model)

    def _register_anywhere(self, keyframe: Keyframe) -> KeyframeReport:
        """By the neighbours in time; failing that, by views that look alike."""
        report = KeyframeReport(keyframe.stamp, False, "no model has been started yet", 0, 0.0)
        for model in sorted(self.map.models, key=lambda model: _gap(model, keyframe.stamp))[:2]:
            report = self._register(model, keyframe, self._neighbours(model, keyframe), COARSE)
            if report.registered:
                return report
        for model in sorted(self.map.models, key=len, reverse=True)[:2]:
            similar = self._localizer.next_similar_views(model, keyframe)
            if len(similar):
                report = self._register(model, keyframe, similar, None)
            if report.registered:
                return report
        return report

    def _register(self, model: SparseModel, keyframe: Keyframe, views: IntArray, count: int | None) -> KeyframeReport:
        """In one model, by `count` features of some of its views; undone when the pose is rejected."""
        stamp = keyframe.stamp
        motion = predicted_motion(model, keyframe, self.map.keyframes, self.map.readout) if self.map.readout else None
        if motion is not None:
            keyframe = unrolled_by(model, keyframe, motion)
        matches = self._localizer.matches(model, keyframe, views, count)
        location = self._localizer.locate(model, keyframe, matches)
        if motion is not None and location.camera_from_model is not None:
            # A wrong prediction bends the pose, and the pose the velocities that follow: the matches' rows tell more.
            motion = told_by_rows(model, keyframe, location.camera_from_model, location.pairs, motion)
            other = unrolled_by(model, keyframe, motion)
            again = self._localizer.locate(model, other, matches)
            if len(again.pairs) > len(location.pairs):
                keyframe, location = other, again
        if location.camera_from_model is None:
            return KeyframeReport(stamp, False, location.reason, 0, 0.0)
        self.map.keyframes[stamp] = keyframe
        view = add_view(model, keyframe, location, self.map.keyframes, self.map.readout)
        self.map.matches[stamp] = matches
        rejection = rejection_reason(model, view, matches)
        if rejection:
            self.map.remove_view(model, view)
            return KeyframeReport(stamp, False, rejection, len(location.pairs), 0.0)
        if len(model) >= GROWTH * model.adjusted_at:
            self.map.adjust_globally(model)
        return KeyframeReport(stamp, True, "", len(location.pairs), 0.0)

    def _neighbours(self, model: SparseModel, keyframe: Keyframe) -> IntArray:
        """The two views of its camera nearest in time, and the nearest one of each other camera of a rig."""
        gap = np.abs(np.array(model.stamps) - keyframe.stamp)
        count: Counter[str] = Counter()
        near = []
        for view in np.argsort(gap, kind="stable"):
            frame = self.map.keyframes[model.stamps[view]].frame
            if gap[view] and count[frame] < (2 if frame == keyframe.frame else 1):
                count[frame] += 1
                near.append(view)
        return np.array(near, np.int64)

    def _start_model(self, keyframe: Keyframe) -> bool:
        """Starts a model from the new keyframe and the waiting one with which most points can be triangulated."""
        best: SparseModel | None = None
        cameras = len({self.map.keyframes[stamp].frame for stamp in self.map.waiting})
        for stamp in self.map.waiting[-START_CANDIDATES * cameras - 1 : -1]:
            waiting = self.map.keyframes[stamp]
            matches = self._retrieval.matches(waiting, keyframe, COARSE)
            model = model_from_pair(waiting, keyframe, matches, self._seed)
            if model is not None and (best is None or _observations(model) > _observations(best)):
                best = model
        if best is None:
            return False
        self.map.models.append(best)
        self.map.revision += 1
        if self.map.readout:
            self.map.adjust_globally(best, MAX_TURNS)
        self.map.waiting = [stamp for stamp in self.map.waiting if stamp not in best.stamps]
        return True

    def _retry_near(self, stamp: int) -> None:
        """Tries the waiting keyframes nearest in time to a registered one."""
        self._retry_from(stamp, self.map.waiting, RETRIES)

    def _retry_from(self, stamp: int, stamps: list[int], count: int | None = None) -> None:
        """Tries waiting keyframes, the nearest in time to `stamp` first, at most `count` of them."""
        self._retry(sorted(stamps, key=lambda other: abs(other - stamp))[:count])

    def _retry(self, stamps: list[int]) -> None:
        for stamp in stamps:
            if self._register_anywhere(self.map.keyframes[stamp]).registered:
                self.map.waiting.remove(stamp)

    def _report(self, stamp: int) -> KeyframeReport:
        model = self.map.model_of(stamp)
        if model is None:
            return KeyframeReport(stamp, False, "the global adjustment has rejected its pose", 0, 0.0)
        own = np.arange(*model.offsets[model.stamps.index(stamp) :][:2])
        own = own[model.point_of[own] >= 0]
        return KeyframeReport(stamp, True, "", len(own), float(model.errors(own).mean()) if len(own) else 0.0)


def _observations(model: SparseModel) -> int:
    """Number of features that have a point."""
    return int((model.point_of >= 0).sum())


def _with_camera(keyframe: Keyframe, told: Camera, camera: Camera) -> Keyframe:
    """A keyframe with another calibration in place of the one told."""
    return keyframe.with_camera(camera) if keyframe.camera == told != camera else keyframe


def _gap(model: SparseModel, stamp: int) -> int:
    """Time to the model's nearest view, ns."""
    return min(abs(other - stamp) for other in model.stamps)
