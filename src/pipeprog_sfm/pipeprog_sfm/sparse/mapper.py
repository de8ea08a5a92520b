"""Streaming structure from motion: keyframes in, poses and points of one map out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.sparse.features import Features, extract
from pipeprog_sfm.sparse.guided_matching import link, partners
from pipeprog_sfm.sparse.keyframe import Keyframe
from pipeprog_sfm.sparse.loop_closure import correction_weights, distribute_correction, is_drift, loop_candidates
from pipeprog_sfm.sparse.matching import MatchArray
from pipeprog_sfm.sparse.model_merging import merge, similarity_between
from pipeprog_sfm.sparse.overlap import OverlapReport, OverlapTracker
from pipeprog_sfm.sparse.registration import LOCAL_WINDOW, MIN_INLIERS, Location, add_view, locate, rejection_reason
from pipeprog_sfm.sparse.retrieval import GLANCE, Retrieval
from pipeprog_sfm.sparse.sparse_model import SparseModel
from pipeprog_sfm.sparse.two_view import model_from_pair

COARSE = 1500  # strongest features that are matched without a prediction: enough for a pose, a seventh of the cost
GLANCED = MIN_INLIERS * GLANCE // COARSE  # matches of so few features that make a full comparison worth while
GROWTH = 1.3  # in views, between two global adjustments
LOOKOUT = 4  # keyframes from one look for a loop to the next: known ground stays in view for longer
RETRIES = 3  # waiting keyframes tried again with each new one
START_CANDIDATES = 8  # waiting keyframes that a new one may start a model with
REMEMBERED = 100  # retired keyframes whose features are kept for when they are called for again: 60 MB
ERROR_SAMPLE = 20_000  # observations whose mean error is told: a hundredth of a pixel exact


@dataclass(frozen=True)
class KeyframeReport:
    """What became of a keyframe: inliers of its pose, mean reprojection error in px; reason when not registered."""

    stamp: int
    registered: bool
    reason: str
    inliers: int
    reprojection_error: float


class Mapper:
    """Registers each keyframe as it comes; the published model is the chosen one, else the largest."""

    def __init__(self, config: MapperConfig, seed: int = 0) -> None:
        self._config = config
        self._seed = seed
        self._keyframes: dict[int, Keyframe] = {}
        self._retired: dict[int, Keyframe] = {}
        self._waiting: list[int] = []
        self._models: list[SparseModel] = []
        self._evidence: dict[int, dict[int, MatchArray]] = {}  # matches by which each keyframe was registered
        self._chosen: int | None = None
        self._revision = 0
        self._retrieval = Retrieval()
        self._overlaps = OverlapTracker()

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
        return self._add(known or Keyframe.of(stamp, extract(gray, camera, self._config), camera))

    def add_features(self, stamp: int, features: Features, camera: Camera) -> KeyframeReport:
        """Takes a keyframe whose features are known."""
        return self._add(Keyframe.of(stamp, features, camera))

    def _add(self, keyframe: Keyframe) -> KeyframeReport:
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
        other = Keyframe.of(stamp, features, known.camera)
        model = self._model_of(stamp) or min(self._models, key=lambda model: _distance(model, stamp), default=None)
        if model is None or len(model) < 3:
            return False
        agreeing = []
        for keyframe in (known, other):
            self._retrieval.forget(stamp)
            agreeing.append(len(self._locate(model, keyframe, _neighbours(model, stamp)).pairs))
        if agreeing[1] <= agreeing[0]:
            self._retrieval.forget(stamp)
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
            self._retrieval.forget(stamp)
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
            if len(self._retired) > REMEMBERED:
                del self._retired[next(iter(self._retired))]
            self._overlaps.forget(stamp)
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
        return self._published.poses() if self._models else {}

    def pieces(self) -> list[dict[int, FloatArray]]:
        """Poses (4, 4) camera_from_model by stamp of all models, the largest one first."""
        return [model.poses() for model in sorted(self._models, key=len, reverse=True)]

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
        return model.points[model.seen(model.stamps.index(stamp))]

    def points(self, stamp: int) -> FloatArray:
        """(P, 3) points of the model that holds a keyframe."""
        model = self._model_of(stamp)
        assert model is not None
        return model.points[model.seen_by_any()]

    def observations(self) -> tuple[FloatArray, dict[int, tuple[IntArray, FloatArray]]]:
        """(P, 3) points of the published model, and what each keyframe sees of them.

        By stamp: (K,) rows of the points and (K, 2) pixels of the ideal pinhole image.
        """
        model = self._published
        ids = model.seen_by_any()
        row = np.full(len(model.points), -1)
        row[ids] = np.arange(len(ids))
        seen = {}
        for view in np.argsort(model.stamps, kind="stable"):
            stamp = model.stamps[view]
            own = model.point_of[model.features(view)]
            pixels = self._keyframes[stamp].features.keypoints[own >= 0].astype(np.float64)
            seen[stamp] = row[own[own >= 0]], pixels
        return model.points[ids], seen

    def ties(self) -> list[OverlapReport]:
        """Overlap of the keyframes for which it changed since the last call."""
        return self._overlaps.changed(self._keyframes, self._published if self._models else SparseModel())

    def _model_of(self, stamp: int) -> SparseModel | None:
        return next((model for model in self._models if stamp in model.stamps), None)

    def _report(self, stamp: int) -> KeyframeReport:
        model = self._model_of(stamp)
        if model is None:
            return KeyframeReport(stamp, False, "the global adjustment has refused its pose", 0, 0.0)
        own = np.arange(*model.offsets[model.stamps.index(stamp) :][:2])
        own = own[model.point_of[own] >= 0]
        return KeyframeReport(stamp, True, "", len(own), float(model.errors(own).mean()) if len(own) else 0.0)

    def _register_anywhere(self, keyframe: Keyframe) -> KeyframeReport:
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

    def _register(self, model: SparseModel, keyframe: Keyframe, anchors: IntArray, count: int | None) -> KeyframeReport:
        """In one model, by its views `anchors`; taken back when the result is thin or contradictory."""
        stamp = keyframe.stamp
        matches = self._matches(model, keyframe, anchors, count)
        location = locate(model, keyframe, matches, self._seed)
        if location.camera_from_model is None:
            return KeyframeReport(stamp, False, location.reason, 0, 0.0)
        view = add_view(model, keyframe, location, self._keyframes)
        self._evidence[stamp] = matches
        refusal = rejection_reason(model, view, matches)
        if refusal:
            self._drop(model, view)
            return KeyframeReport(stamp, False, refusal, len(location.pairs), 0.0)
        if len(model) >= GROWTH * model.adjusted_at:
            self._adjust_globally(model)
        return KeyframeReport(stamp, True, "", len(location.pairs), 0.0)

    def _locate(self, model: SparseModel, keyframe: Keyframe, anchors: IntArray) -> Location:
        return locate(model, keyframe, self._matches(model, keyframe, anchors, None), self._seed)

    def _matches(
        self, model: SparseModel, keyframe: Keyframe, views: IntArray, count: int | None
    ) -> dict[int, MatchArray]:
        """By stamp: matches with views, of the `count` strongest features (None: of all)."""
        stamps = [model.stamps[view] for view in views]
        return {stamp: self._retrieval.matches(keyframe, self._keyframes[stamp], count) for stamp in stamps}

    def _alike(self, model: SparseModel, keyframe: Keyframe) -> IntArray:
        """Views, out of the few that it is the turn of, that share most of the strongest features."""
        return self._resembling(model, keyframe, self._retrieval.turn(len(model)), 1)

    def _resembling(self, model: SparseModel, keyframe: Keyframe, views: IntArray, least: int) -> IntArray:
        """Those views that share most of the strongest features, and at least so many."""
        others = [self._keyframes[model.stamps[view]] for view in views]
        return views[self._retrieval.resembling(keyframe, others, least)]

    def _drop(self, model: SparseModel, view: int) -> None:
        self._evidence.pop(model.stamps[view], None)  # the two that started the model have none
        model.drop(view)

    def _start(self, keyframe: Keyframe) -> bool:
        """Starts a model from the new keyframe and the waiting one with which most points can be triangulated."""
        best: SparseModel | None = None
        for stamp in self._waiting[-START_CANDIDATES - 1 : -1]:
            waiting = self._keyframes[stamp]
            matches = self._retrieval.matches(waiting, keyframe, COARSE)
            model = model_from_pair(waiting, keyframe, matches, self._seed)
            if model is not None and (best is None or _tracks(model) > _tracks(best)):
                best = model
        if best is None:
            return False
        self._models.append(best)
        self._revision += 1
        self._waiting = [stamp for stamp in self._waiting if stamp not in best.stamps]
        return True

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
            found = similarity_between(own, own.stamps.index(stamp), other, self._locate(other, keyframe, alike))
            if found is not None:
                self._join(own, other, *found, stamp)
                return

    def _join(self, own: SparseModel, other: SparseModel, scale: float, other_from_own: FloatArray, stamp: int) -> None:
        """Makes two models one that meet at a keyframe."""
        gone, whole = merge(own, other, scale, other_from_own)
        self._models = [model for model in self._models if model is not gone]
        # The seam is tight where the keyframe saw both, and is sewn up from there.
        for view in sorted(range(len(whole)), key=lambda view: abs(whole.stamps[view] - stamp))[: 2 * LOCAL_WINDOW]:
            link(whole, view, self._keyframes)
        self._adjust_globally(whole)
        for moved in gone.stamps:
            if moved in whole.stamps:
                link(whole, whole.stamps.index(moved), self._keyframes)
        self._adjust_globally(whole)

    def _close(self, stamp: int) -> None:
        """Closes a loop: where the keyframe is back at known ground that its points are not tied to, these are one."""
        model = self._model_of(stamp)
        if model is None:
            return
        view = model.stamps.index(stamp)
        if view % LOOKOUT:
            return
        known = loop_candidates(model, view)
        if not len(known):
            return
        keyframe = self._keyframes[stamp]
        near = np.intersect1d(np.array(partners(model, view, keyframe.camera), np.int64), known)
        views = np.union1d(near, known[self._retrieval.turn(len(known))])
        alike = self._resembling(model, keyframe, views, GLANCED)
        if not len(alike):
            return
        found = similarity_between(model, view, model, self._locate(model, keyframe, alike))
        if found is None or not is_drift(model, view, int(alike[0]), *found):
            return
        distribute_correction(model, correction_weights(model, alike, view), *found)
        order = np.argsort(model.stamps)
        place = int(np.flatnonzero(order == view)[0])
        for other in order[max(place - LOCAL_WINDOW, 0) : place + LOCAL_WINDOW]:
            link(model, int(other), self._keyframes)
        self._adjust_globally(model)

    def _adjust_globally(self, model: SparseModel) -> None:
        """Adjusts all views, and sends those back to wait whose poses turn out wrong."""
        model.adjust(None, 10, 1e-3)
        for view in reversed(range(len(model))):
            if len(model) > 2 and rejection_reason(model, view, self._evidence.get(model.stamps[view], {})):
                self._waiting.append(model.stamps[view])
                self._drop(model, view)
        model.adjusted_at = len(model)
        self._revision += 1


def _tracks(model: SparseModel) -> int:
    return int((model.point_of >= 0).sum())


def _distance(model: SparseModel, stamp: int) -> int:
    """Time to the model's nearest view, ns."""
    return min(abs(other - stamp) for other in model.stamps)


def _neighbours(model: SparseModel, stamp: int) -> IntArray:
    """The two views nearest in time, without the keyframe itself."""
    gap = np.abs(np.array(model.stamps) - stamp)
    return np.array([view for view in np.argsort(gap, kind="stable")[:3] if gap[view]][:2], np.int64)
