# SPDX-License-Identifier: Apache-2.0
"""The sparse map: all keyframes, the models that hold some of them, and the model that is published."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray
from pipeprog_sfm.model.model_adjustment import adjust_model, pose_covariance
from pipeprog_sfm.model.row_motion import row_motions, unroll
from pipeprog_sfm.model.self_calibration import RADII, radial_residuals
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.overlap import OverlapReport, OverlapTracker
from pipeprog_sfm.sparse.registration import rejection_reason

ERROR_SAMPLE = 20_000  # observations that give the mean error: with a spread of 1 px, to 1 / sqrt(20 000) = 0.007 px
MAX_TURNS = 3  # of shifts and poses where they are to settle: see `row_motion`
SETTLED = 0.02  # px; a change of all features of a view by less moves its pose by less than their noise (0.3 px / 20)


class SparseMap:
    """Keyframes by stamp and the models they are registered in; the mapper changes it, others read it.

    Attributes:
        keyframes: all keyframes that were added and not retired, by stamp.
        waiting: stamps of those without a pose, in the order in which they came.
        models: not connected with each other; the one chosen by `publish`, else the largest, is the published one.
        matches: by stamp of a registered keyframe, its matches with other keyframes by their stamps.
        readout: from the first row of an image to the last, s; 0: all rows at once.
        revision: grows whenever poses of earlier keyframes may have moved as a whole.
    """

    def __init__(self, readout: float = 0.0) -> None:
        self.readout = readout
        self.keyframes: dict[int, Keyframe] = {}
        self.waiting: list[int] = []
        self.models: list[SparseModel] = []
        self.matches: dict[int, dict[int, MatchArray]] = {}
        self.revision = 0
        self._chosen: int | None = None
        self._overlaps = OverlapTracker()

    @property
    def published(self) -> SparseModel:
        """The published model, empty before the first one."""
        chosen = None if self._chosen is None else self.model_of(self._chosen)
        return chosen or max(self.models, key=len, default=SparseModel())

    def publish(self, stamp: int) -> None:
        """Chooses the model that holds a keyframe, and what it will be merged with, for publication."""
        self._chosen = stamp

    def model_of(self, stamp: int) -> SparseModel | None:
        """The model that a keyframe is registered in."""
        return next((model for model in self.models if stamp in model.stamps), None)

    def remove_view(self, model: SparseModel, view: int) -> None:
        """Takes a view out of its model; its keyframe stays, and is neither registered nor waiting."""
        self.matches.pop(model.stamps[view], None)  # the two views that started the model have none
        model.drop(view)

    def give_up(self, model: SparseModel) -> list[int]:
        """Takes a model apart: its keyframes wait again. Returns their stamps."""
        self.models.remove(model)
        self.waiting += model.stamps
        for stamp in model.stamps:
            self.matches.pop(stamp, None)
        self.revision += 1
        return model.stamps

    def retire(self, stamps: Collection[int]) -> list[Keyframe]:
        """Takes keyframes out: pose and observations; returns them. Unknown stamps are ignored.

        A point that fewer than two other views see is removed. A view that is left alone in its model waits again.
        """
        retired = [self.keyframes.pop(stamp) for stamp in stamps if stamp in self.keyframes]
        for keyframe in retired:
            self._overlaps.forget(keyframe.stamp)
            model = self.model_of(keyframe.stamp)
            if model is None:
                self.waiting.remove(keyframe.stamp)
            else:
                self.remove_view(model, model.stamps.index(keyframe.stamp))
        for model in list(self.models):
            if len(model) < 2:
                self.give_up(model)
            elif stamps:
                model.filter(*model.observations(np.ones(len(model.points), bool)))
        return retired

    def adjust_globally(self, model: SparseModel, turns: int = 1, by_spline: int = 0) -> None:
        """Adjusts all views of a model; views whose poses are rejected afterwards wait again.

        With a rolling shutter:

        Args:
            model: of this map.
            turns: of the shifts of features and the poses; a map that grows goes on at the next.
            by_spline: of these before, with the velocities of the poses alone: they undo what is bent (`row_motion`).
        """
        if self.readout:
            self._adjust_rolling(model, by_spline, rows_correct=False)
            self._adjust_rolling(model, turns, rows_correct=True)
        else:
            adjust_model(model)
        for view in reversed(range(len(model))):
            if len(model) > 2 and rejection_reason(model, view, self.matches.get(model.stamps[view], {})):
                self.put_back(model, view)
        model.adjusted_at = len(model)
        self.revision += 1

    def put_back(self, model: SparseModel, view: int) -> None:
        """Takes a view out of its model, to wait again."""
        self.waiting.append(model.stamps[view])
        self.remove_view(model, view)

    def clear(self) -> None:
        """Takes all keyframes out."""
        for held in (self.keyframes, self.waiting, self.models, self.matches):
            held.clear()
        self.revision += 1

    def spline_motions(self, model: SparseModel, readout: float) -> dict[int, RowMotion]:
        """As `motions`, by the poses and a read-out [s] alone: velocities that rows correct take up its error, too."""
        return row_motions(model, self.keyframes, readout).of_all(rows_correct=False) if readout else {}

    def motions(self, model: SparseModel) -> dict[int, RowMotion]:
        """How a model moves as seen from its views while their rows are read out, by stamp; empty without readout.

        These are the motions that its features were unrolled with.
        """
        used = {stamp: self.keyframes[stamp].motion for stamp in model.stamps}
        return {stamp: motion for stamp, motion in used.items() if motion is not None}

    def _adjust_rolling(self, model: SparseModel, turns: int, rows_correct: bool) -> None:
        """Finds shifts of features and poses in turns, until the shifts stay; rows_correct: see `ToldMotions`."""
        for _ in range(turns):
            motions = row_motions(model, self.keyframes, self.readout).of_all(rows_correct)
            change = unroll(model, self.keyframes, motions)
            adjust_model(model)
            if change < SETTLED:
                return

    def camera_from_model(self) -> dict[int, FloatArray]:
        """Poses (4, 4) of the published model's keyframes, in order of time."""
        return self.published.poses()

    def reprojection_error(self) -> float:
        """Mean over the published model's observations, px; 0 without a model."""
        model = self.published
        features = np.flatnonzero(model.point_of >= 0)
        features = features[:: max(len(features) // ERROR_SAMPLE, 1)]
        return float(model.errors(features).mean()) if len(features) else 0.0

    def radial_residuals(self) -> FloatArray:
        """As of `self_calibration.radial_residuals`, of the published model; NaN without one."""
        model = self.published
        return radial_residuals(model, self.keyframes[model.stamps[0]].camera) if len(model) else np.full(RADII, np.nan)

    def covariance(self, stamp: int, gradients: FloatArray) -> FloatArray:
        """(S, S) covariance of functions of the poses of the model that holds a keyframe.

        gradients (S, N, 6): derivatives by each of its poses, in order of time; see `function_covariance`.
        """
        model = self.model_of(stamp)
        assert model is not None
        return pose_covariance(model, gradients[:, np.argsort(np.argsort(model.stamps, kind="stable"))])

    def points_seen(self, stamp: int) -> FloatArray:
        """(K, 3) points in the model that a keyframe of the published model sees."""
        model = self.published
        return model.points[model.seen(model.stamps.index(stamp))]

    def points(self, stamp: int) -> FloatArray:
        """(P, 3) points of the model that holds a keyframe."""
        model = self.model_of(stamp)
        assert model is not None
        return model.points[model.seen_by_any()]

    def observations(self) -> tuple[FloatArray, dict[int, tuple[IntArray, FloatArray]]]:
        """(P, 3) points of the published model, and what each keyframe sees of them.

        By stamp: (K,) rows of the points and (K, 2) pixels of the ideal pinhole image.
        """
        model = self.published
        ids = model.seen_by_any()
        row = np.full(len(model.points), -1)
        row[ids] = np.arange(len(ids))
        seen = {}
        for view in np.argsort(model.stamps, kind="stable"):
            stamp = model.stamps[view]
            own = model.point_of[model.features(view)]
            pixels = self.keyframes[stamp].features.keypoints[own >= 0].astype(np.float64)
            seen[stamp] = row[own[own >= 0]], pixels
        return model.points[ids], seen

    def overlap_reports(self) -> list[OverlapReport]:
        """Overlap of the keyframes for which it changed since the last call."""
        return self._overlaps.changed(self.keyframes, self.published, places=not self.readout)
