# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter of a sparse model: how each view moves, and its features where the middle row's camera has them.

The velocities are never unknowns of each view alone: velocities that are free, even by 0.02 rad/s and 0.04 m/s, bend
the scene at no cost where all images are read out in one direction (Albl, Sugimoto, Pajdla, ECCV 2016; seen here: 0.2
m/s off after some rounds of adjustment). They are those of a smooth trajectory through the poses, and what the rows of
a view tell beside points that many views hold moves it between these (`motion_smoothing`). The accelerations are its
own, too: at 3 m/s^2, first and last row of 20 ms lie 0.15 mm off without them, which moves a pose by several times as
much along what the rows hold poorly.

Features are shifted by velocity and depth to where a camera with all rows at the stamp would have seen them, and all
that follows is that of a global shutter. Shifts and poses are found in turns. An error of the poses that repeats every
T seconds comes back through the velocities multiplied by pi * readout / T, a tenth where keyframes are 0.2 s apart and
the read-out is 15 ms: three turns do. What bends the scene and the velocities that rows tell together comes back nearly
as it was, though (0.94 of it, at 1.4 m/s). It is there after another read-out, and where a map has grown: turns by the
poses alone (`pose_spline`) undo it, before those in which rows correct.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Mapping, MutableMapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.motion_smoothing import smoothed
from pipeprog_sfm.model.pose_spline import apart, spline_rates
from pipeprog_sfm.model.row_fit import ViewRows, fit_rows
from pipeprog_sfm.model.sparse_model import SparseModel

MAX_GAP = 1.0  # s between two views that still tell the velocity between them: a hand sways at 1 to 2 Hz
NEAR = 16  # views nearest in time that tell how one moves: a knot has 0.43 of the say of the one before
# rad/s and depths of the scene per second, for each second to the next pose: how far a predicted velocity is off, which
# follows a hand's accelerations (1 rad/s^2, 1 m/s^2 at 1 to 2 m) from one side alone.
END_CHANGE = 1.0
# Views from an end inwards whose spline its condition moves, each 0.43 times as much as the one before; the fifth by a
# thirtieth.
END_KNOTS = 4
# Views of a trajectory of which these, at its ends, are a quarter at most: of nine, six whose rows decide bend the
# scene. In a shorter one that is left to the outermost alone.
LONG_TRAJECTORY = 4 * 2 * END_KNOTS
# Standard deviations, as the median of all has it, by which what rows tell differs from the spline where that is wrong,
# as at a jerk: with six numbers of each of 100 views, by chance in one trajectory of 25.
CONTRADICTED = 4.0
NORMAL_SPREAD = 1.4826  # standard deviations of a normal distribution in its median absolute deviation
READOUT_STEP = 1e-4  # s of a numerical derivative: moves a feature by 0.01 px, far above rounding (1e-9)
# Views of a point that tells how one of them moves: with fewer, that view has too much say in where the point is, and
# the point follows the view's own error.
LONG_TRACK = 6


@dataclass(frozen=True)
class ToldMotions:
    """Motions by stamp: of all views by the spline, of those where their rows decide, and of all that rows correct.

    Rows tell the product of velocity and read-out: the velocities on which they decide take up an error of the latter.
    """

    by_spline: dict[int, RowMotion]
    decided: dict[int, RowMotion]
    corrected: dict[int, RowMotion]

    def of_all(self, rows_correct: bool = True) -> dict[int, RowMotion]:
        """Of all views; without `rows_correct` those that do not contradict the spline have its velocities."""
        return self.by_spline | (self.corrected if rows_correct else {}) | self.decided


def row_motions(
    model: SparseModel,
    keyframes: Mapping[int, Keyframe],
    readout: float,
    near: IntArray | None = None,
    count: int | None = None,
) -> ToldMotions:
    """How the model moves as seen from its views, by what tells it; views of which it is unknown are left out.

    Lengths are in the unit of the model. Each camera of a rig has a trajectory of its own. With `near`, the trajectory
    is that of these views alone, and the motions are those of the first `count` of them.
    """
    views = np.arange(len(model)) if near is None else near
    wanted = set(views[:count].tolist())
    by_camera: defaultdict[object, list[int]] = defaultdict(list)
    for view in views.tolist():
        keyframe = keyframes[model.stamps[view]]
        by_camera[keyframe.frame, keyframe.camera].append(view)
    centres = model.centres()
    found = ToldMotions({}, {}, {})
    for members in by_camera.values():
        order = np.array(sorted(members, key=model.stamps.__getitem__))
        stamps = np.array([model.stamps[view] for view in order], np.int64)
        ends = np.flatnonzero(np.diff(stamps) > MAX_GAP * 1e9) + 1
        for part in np.split(order, ends):
            own = [model.stamps[view] for view in part]
            rates = spline_rates(own, model.rotation[part], centres[part])  # none of a single view
            motions = {
                stamp: RowMotion(readout, keyframes[stamp].camera.height, *of_view)
                for stamp, *of_view in zip(own, *rates, strict=False)
            }
            if motions and readout > 0.0:
                is_long = near is None and len(part) >= LONG_TRAJECTORY
                decided, corrected = _by_rows(model, part, keyframes, motions, wanted, is_long)
                found.decided.update(decided)
                found.corrected.update(corrected)
            asked = {model.stamps[view] for view in part if view in wanted}
            found.by_spline.update((stamp, motion) for stamp, motion in motions.items() if stamp in asked)
    return found


def unroll(model: SparseModel, keyframes: MutableMapping[int, Keyframe], motions: Mapping[int, RowMotion]) -> float:
    """Gives the model's views of `motions` (by stamp) and their keyframes the features of the middle row's camera.

    A feature without a point is shifted as if at the depth of the nearest one in the image that has one. Returns the
    largest root mean square over a view of the change of its features, px.
    """
    change = 0.0
    for stamp, motion in motions.items():
        view = model.stamps.index(stamp)
        depths = feature_depths(model, view, keyframes[stamp])
        if depths is None:
            continue
        before = keyframes[stamp].rays
        keyframes[stamp] = keyframe = keyframes[stamp].unrolled(motion, depths)
        model.rays[model.features(view)] = keyframe.rays
        moved = (keyframe.rays - before) * keyframe.focal
        change = max(change, float(np.sqrt((moved**2).sum(axis=1).mean())))
    return change


def readout_rates(
    model: SparseModel, keyframes: Mapping[int, Keyframe], motions: Mapping[int, RowMotion], features: IntArray
) -> FloatArray:
    """(K, 2) px of the image as it is, per second by which the read-out grows: how unrolled features move.

    Args:
        model: views and points.
        keyframes: of the model's views, by stamp.
        motions: of the views, by stamp; the features of other views do not move.
        features: (K,) flat ones that have a point.
    """
    rates = np.zeros((len(features), 2))
    for view, stamp in enumerate(model.stamps):
        own = np.flatnonzero(model.view_of[features] == view)
        if stamp not in motions or not len(own):
            continue
        keyframe, motion = keyframes[stamp], motions[stamp]
        measured = keyframe.measured[features[own] - model.offsets[view]].astype(np.float64)
        depths = model.points[model.point_of[features[own]]] @ model.rotation[view, 2] + model.translation[view, 2]
        ends = [
            keyframe.camera.distort_points(
                replace(motion, readout=motion.readout + step).unrolled_pixels(measured, depths, keyframe.camera)
            )
            for step in (0.0, READOUT_STEP)
        ]
        rates[own] = (ends[1] - ends[0]) / READOUT_STEP
    return rates


def predicted_motion(
    model: SparseModel, keyframe: Keyframe, keyframes: Mapping[int, Keyframe], readout: float
) -> RowMotion | None:
    """How the view of its camera that is nearest in time to the keyframe moves; None where it is unknown or far."""
    near = near_in_time(model, keyframe.stamp)
    nearest = keyframes[model.stamps[int(near[0])]]
    another = (nearest.frame, nearest.camera) != (keyframe.frame, keyframe.camera)
    if another or abs(nearest.stamp - keyframe.stamp) > MAX_GAP * 1e9:
        return None
    return row_motions(model, keyframes, readout, near, 1).of_all().get(nearest.stamp)


def unrolled_by(model: SparseModel, keyframe: Keyframe, motion: RowMotion) -> Keyframe:
    """A keyframe with features unrolled at the median depth of the view nearest in time."""
    first = int(near_in_time(model, keyframe.stamp)[0])
    seen = model.points[model.seen(first)]
    if not len(seen):
        return keyframe
    depth = np.median(seen @ model.rotation[first, 2]) + model.translation[first, 2]
    return keyframe.unrolled(motion, np.full(len(keyframe.measured), depth))


def told_by_rows(
    model: SparseModel, keyframe: Keyframe, camera_from_model: FloatArray, pairs: IntArray, motion: RowMotion
) -> RowMotion:
    """How a keyframe moves by its own rows, with a predicted motion as the prior.

    camera_from_model (4, 4): about its pose; pairs (K, 2): its features and the points of the model that they show.
    """
    gap = int(np.abs(np.array(model.stamps) - keyframe.stamp).min()) * 1e-9
    inside = model.points[pairs[:, 1]] @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]
    return fit_rows(ViewRows.of(inside, keyframe, pairs[:, 0], model.noise, motion), motion, END_CHANGE * gap)


def near_in_time(model: SparseModel, stamp: int) -> IntArray:
    """The NEAR views nearest in time to a stamp, the nearest first."""
    return np.argsort(np.abs(np.array(model.stamps) - stamp), kind="stable")[:NEAR]


def feature_depths(model: SparseModel, view: int, keyframe: Keyframe) -> FloatArray | None:
    """(N,) depths of a view's features: of their points, or of the nearest feature with one; None without any."""
    own = model.point_of[model.features(view)]
    depths = model.points[own] @ model.rotation[view, 2] + model.translation[view, 2]
    has = (own >= 0) & (depths > 0)
    if not has.any():
        return None
    nearest = cKDTree(keyframe.measured[has], balanced_tree=False).query(keyframe.measured[~has])[1]
    depths[~has] = depths[has][nearest]
    return np.asarray(depths)


def _by_rows(
    model: SparseModel,
    views: IntArray,
    keyframes: Mapping[int, Keyframe],
    motions: Mapping[int, RowMotion],
    wanted: Container[int],
    is_long: bool,
) -> tuple[dict[int, RowMotion], dict[int, RowMotion]]:
    """The spline's `motions` of the `wanted` among views in order of time, as rows have them: `decided`, `corrected`.

    Both by stamp; the spline is no alternative at the ends, and where what rows tell contradicts it.
    """
    stamps = [model.stamps[view] for view in views]
    times = (np.array(stamps) - stamps[0]) * 1e-9
    has_many = np.bincount(model.point_of[model.point_of >= 0], minlength=len(model.points)) >= LONG_TRACK

    def rows_of(view: int, stamp: int) -> ViewRows | None:
        if view not in wanted or not (is_long or view in (views[0], views[-1])):
            return None
        own = model.point_of[model.features(view)]
        features = np.flatnonzero((own >= 0) & has_many[own])
        inside = model.points[own[features]] @ model.rotation[view].T + model.translation[view]
        return ViewRows.of(inside, keyframes[stamp], features, model.noise, motions[stamp])

    knots = apart(times)
    views, stamps = views[knots], [stamps[knot] for knot in knots]
    before = [motions[stamp] for stamp in stamps]
    rows = [rows_of(view, stamp) for view, stamp in zip(views.tolist(), stamps, strict=True)]
    after, differences = smoothed(times[knots], model.rotation[views], model.centres()[views], before, rows)
    is_wrong = contradicted(differences)
    ends = END_KNOTS if is_long else 1
    is_wrong[:ends] = is_wrong[-ends:] = True
    numbers = [number for number, view in enumerate(views.tolist()) if view in wanted]
    corrected = {stamps[number]: after[number] for number in numbers}
    return {stamps[number]: after[number] for number in numbers if is_wrong[number]}, corrected


def contradicted(differences: FloatArray) -> NDArray[np.bool_]:
    """(N,) whether any of (N, 6) differences [standard deviations, not negative] is beyond most others of its kind."""
    return np.asarray((differences > CONTRADICTED * NORMAL_SPREAD * np.median(differences, axis=0)).any(axis=1))
