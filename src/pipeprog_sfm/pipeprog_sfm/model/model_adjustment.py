# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a sparse model, and the covariance of what follows from its poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.model.bundle_adjustment import CAUCHY, Bundle, adjust, function_covariance
from pipeprog_sfm.model.sparse_model import SparseModel

NOISE_RANGE = (0.1, 1.0)  # px, of a coordinate: what image noise and SIFT's localisation allow
RAYLEIGH_MEDIAN = 1.1774  # median length of a 2-D normal error, in standard deviations of a coordinate
MAX_ITERATIONS = 10  # of Levenberg-Marquardt: from poses that are known already it converges within a few
TOLERANCE = 1e-3  # of the cost: an iteration that gains less moves the poses by less than their uncertainty


def adjust_model(model: SparseModel, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> None:
    """Adjusts all views and points (the first view stays fixed), and estimates the noise of the features anew."""
    free = np.ones(len(model), bool)
    free[:1] = False
    used = _adjust(model, free, np.ones(len(model.points), bool), max_iterations, tolerance)
    if used is None:
        return
    error = float(np.median(model.errors(used[2]))) / RAYLEIGH_MEDIAN
    model.noise = min(max(error, NOISE_RANGE[0]), NOISE_RANGE[1])
    model.filter(*used)
    model.forget_unseen()


def adjust_views(model: SparseModel, views: IntArray) -> None:
    """Adjusts some views and the points that these see; the other views that see these points stay fixed."""
    free = np.zeros(len(model), bool)
    free[views] = True
    free[0] = False
    chosen = np.zeros(len(model.points), bool)
    chosen[np.concatenate([model.seen(view) for view in views])] = True
    used = _adjust(model, free, chosen, MAX_ITERATIONS, TOLERANCE)
    if used is not None:
        model.filter(*used)


def adjust_points(model: SparseModel) -> None:
    """Adjusts all points; the views stay as they are."""
    _adjust(model, np.zeros(len(model), bool), np.ones(len(model.points), bool), MAX_ITERATIONS, TOLERANCE)


def pose_covariance(model: SparseModel, gradients: FloatArray) -> FloatArray:
    """(S, S) covariance of functions of the poses whose derivatives are (S, V, 6): see `function_covariance`."""
    ids, start, features = model.observations(np.ones(len(model.points), bool))
    view = model.view_of[features].astype(np.int64)
    bundle = Bundle(
        model.rotation, model.translation, model.points[ids], start, view, model.rays[features], model.focal
    )
    return function_covariance(gradients, bundle, loss_scale=CAUCHY * model.noise)


def _adjust(
    model: SparseModel, free: NDArray[np.bool_], chosen: NDArray[np.bool_], max_iterations: int, tolerance: float
) -> tuple[IntArray, IntArray, IntArray] | None:
    """Adjusts the free views (V,) bool and the chosen points (P,) bool; returns the observations used, None without."""
    ids, start, features = model.observations(chosen)
    if not len(ids):
        return None
    used, view = np.unique(model.view_of[features], return_inverse=True)
    bundle = Bundle(
        model.rotation[used], model.translation[used], model.points[ids],
        start, view.astype(np.int64), model.rays[features], model.focal[used],
    )  # fmt: skip
    loss_scale = CAUCHY * model.noise
    adjusted = adjust(bundle, free[used], loss_scale=loss_scale, max_iterations=max_iterations, tolerance=tolerance)
    model.rotation[used], model.translation[used] = adjusted.rotation, adjusted.translation
    model.points[ids] = adjusted.points
    return ids, start, features
