# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a sparse model, and the covariance of what follows from its poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.model.bundle_adjustment import RAYLEIGH_MEDIAN, Bundle, adjust, function_covariance
from pipeprog_sfm.model.sparse_model import SparseModel

NOISE_RANGE = (0.1, 1.0)  # px, of a coordinate: what image noise and SIFT's localisation allow
MAX_ITERATIONS = 10  # of Levenberg-Marquardt: from poses that are known already it converges within a few
# Views of a point that tells poses. That two rays nearly meet confirms little: those of a match that is wrong along the
# epipolar line do, and those of features that slide along an edge (ORB-SLAM keeps no others: Mur-Artal et al. 2015).
CONFIRMING = 3
ENOUGH = 100  # such points of a view; with fewer, all count: at 0.3 px 100 tell where the view looks to 0.03 px
# Of the noise before an adjustment. Where less is left, the loss was too wide, and the next one is as narrow as what is
# left: started with that one, views that are off by more would hardly move.
NARROWED = 0.5
TOLERANCE = 1e-3  # of the cost: an iteration that gains less moves the poses by less than their uncertainty
# The same while keyframes come, in place of two of five iterations: the next view's window adjusts seven of eight views
# again. Paths of five labs are off by 0.14, 0.06, 0.08, 0.19 and 0.23 mm with either.
LOCAL_TOLERANCE = 3e-3


def adjust_model(model: SparseModel, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> None:
    """Adjusts all views and points (the first view stays fixed), and estimates the noise of the features anew."""
    free = np.ones(len(model), bool)
    free[:1] = False
    confirmed = _confirmed(model)
    adjusted = _adjust(model, free, confirmed, max_iterations, tolerance)
    if adjusted is None:
        return
    used, model.noise = adjusted
    model.filter(*used)
    _follow(model, ~confirmed)
    model.forget_unseen()


def adjust_views(model: SparseModel, views: IntArray) -> None:
    """Adjusts some views and the points that these see; the other views that see these points stay fixed."""
    free = np.zeros(len(model), bool)
    free[views] = True
    free[0] = False
    chosen = np.zeros(len(model.points), bool)
    chosen[np.concatenate([model.seen(view) for view in views])] = True
    confirmed = _confirmed(model)
    adjusted = _adjust(model, free, chosen & confirmed, tolerance=LOCAL_TOLERANCE)
    if adjusted is not None:
        model.filter(*adjusted[0])
    _follow(model, chosen & ~confirmed)


def adjust_points(model: SparseModel) -> None:
    """Adjusts all points; the views stay as they are."""
    _adjust(model, np.zeros(len(model), bool), np.ones(len(model.points), bool))


def pose_covariance(model: SparseModel, gradients: FloatArray) -> FloatArray:
    """(S, S) covariance of functions of the poses whose derivatives are (S, V, 6): see `function_covariance`."""
    ids, start, features = model.observations(_confirmed(model))
    view = model.view_of[features].astype(np.int64)
    bundle = Bundle(
        model.rotation, model.translation, model.points[ids], start, view, model.rays[features], model.focal
    )
    return function_covariance(gradients, bundle, loss_scale=RAYLEIGH_MEDIAN * model.noise)


def _noise(errors: FloatArray) -> float:
    """Standard deviation of a coordinate, px, told by the median of (K,) errors."""
    return float(np.clip(np.median(errors) / RAYLEIGH_MEDIAN, *NOISE_RANGE))


def _confirmed(model: SparseModel) -> NDArray[np.bool_]:
    """(P,) points that tell poses: of CONFIRMING views or more, or of a view that has few of these."""
    features = np.flatnonzero(model.point_of >= 0)
    point, view = model.point_of[features], model.view_of[features]
    confirmed = np.bincount(point, minlength=len(model.points)) >= CONFIRMING
    has_few = np.bincount(view[confirmed[point]], minlength=len(model)) < ENOUGH
    confirmed[point[has_few[view]]] = True
    return confirmed


def _follow(model: SparseModel, chosen: NDArray[np.bool_]) -> None:
    """Adjusts the chosen points (P,) bool to views that have moved."""
    adjusted = _adjust(model, np.zeros(len(model), bool), chosen)
    if adjusted is not None:
        model.filter(*adjusted[0])


def _adjust(
    model: SparseModel,
    free: NDArray[np.bool_],
    chosen: NDArray[np.bool_],
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> tuple[tuple[IntArray, IntArray, IntArray], float] | None:
    """Adjusts the free views (V,) bool and the chosen points (P,) bool.

    Returns the observations used and the noise [px] that they tell of; None without observations.
    """
    ids, start, features = model.observations(chosen)
    if not len(ids):
        return None
    used = np.flatnonzero(np.bincount(model.view_of[features]))
    number = np.zeros(len(model), np.int64)  # of each view among those used
    number[used] = np.arange(len(used))
    bundle = Bundle(
        model.rotation[used], model.translation[used], model.points[ids],
        start, number[model.view_of[features]], model.rays[features], model.focal[used],
    )  # fmt: skip
    after = _noise(bundle.errors())
    while True:
        before, loss_scale = after, RAYLEIGH_MEDIAN * after
        bundle = adjust(bundle, free[used], loss_scale=loss_scale, max_iterations=max_iterations, tolerance=tolerance)
        after = _noise(bundle.errors())
        if after >= NARROWED * before:
            break
    model.rotation[used], model.translation[used] = bundle.rotation, bundle.translation
    model.points[ids] = bundle.points
    return (ids, start, features), after
