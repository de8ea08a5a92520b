# SPDX-License-Identifier: Apache-2.0
"""Loop closure: where the camera sees a place again, the drift is distributed over the views in between."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.linalg import expm, logm

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.features.retrieval import COARSE, PREVIEW
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.guided_matching import link, partners
from pipeprog_sfm.sparse.localizer import Localizer
from pipeprog_sfm.sparse.model_merging import similarity_between
from pipeprog_sfm.sparse.registration import LOCAL_WINDOW, MIN_INLIERS
from pipeprog_sfm.sparse.sparse_map import SparseMap

LOOP_INTERVAL = 4  # try to close a loop at every 4th keyframe: a revisited place stays in view longer than that
# Matches among the PREVIEW strongest features that make a full comparison worth while: an image that shares MIN_INLIERS
# of the COARSE strongest features shares this many of them.
PREVIEW_MATCHES = MIN_INLIERS * PREVIEW // COARSE
MAX_DRIFT = 0.05  # of the path length since: visual odometry drifts by 1 to 2 %, a larger gap is a look-alike place


def close_loop(sparse_map: SparseMap, localizer: Localizer, stamp: int) -> None:
    """Closes a loop if the keyframe sees a place again whose points it does not share: these become one."""
    model = sparse_map.model_of(stamp)
    if model is None:
        return
    view = model.stamps.index(stamp)
    if view % LOOP_INTERVAL:
        return
    candidates = loop_candidates(model, view)
    if not len(candidates):
        return
    keyframe = sparse_map.keyframes[stamp]
    near = np.intersect1d(np.array(partners(model, view, sparse_map.keyframes), np.int64), candidates)
    views = np.union1d(near, candidates[localizer.next_subset(len(candidates))])
    similar = localizer.similar_views(model, keyframe, views, PREVIEW_MATCHES)
    if not len(similar):
        return
    found = similarity_between(model, view, model, localizer.locate_by(model, keyframe, similar))
    if found is None or not is_drift(model, view, int(similar[0]), *found):
        return
    distribute_correction(model, correction_weights(model, similar, view), *found)
    order = np.argsort(model.stamps)
    rank = int(np.flatnonzero(order == view)[0])
    for other in order[max(rank - LOCAL_WINDOW, 0) : rank + LOCAL_WINDOW]:
        link(model, int(other), sparse_map.keyframes)
    sparse_map.adjust_globally(model)


def loop_candidates(model: SparseModel, view: int, window: int = LOCAL_WINDOW) -> IntArray:
    """Indices of views more than 2 * `window` views earlier or later in time, with which a loop may be closed.

    Empty if the view is covisible with any of them, i.e. no loop is open.
    """
    rank = np.argsort(np.argsort(model.stamps))
    distant = np.abs(rank - rank[view]) > 2 * window
    covisible = (model.covisible(np.array([view]))[0, distant] >= MIN_INLIERS).any()
    return np.flatnonzero(distant & (not covisible))


def is_drift(model: SparseModel, view: int, other: int, scale: float, correction: FloatArray) -> bool:
    """Whether a correction moves a view by no more than MAX_DRIFT of the path between two views.

    correction (4, 4) is rigid, applied after the scale.
    """
    rank, order = np.argsort(np.argsort(model.stamps)), np.argsort(model.stamps)
    between = order[min(rank[view], rank[other]) : max(rank[view], rank[other]) + 1]
    path = np.linalg.norm(np.diff(model.centres()[between], axis=0), axis=1).sum()
    centre = model.centre(view)
    drift = np.linalg.norm(correction[:3, :3] @ centre * scale + correction[:3, 3] - centre)
    return bool(drift <= MAX_DRIFT * path)


def correction_weights(model: SparseModel, kept: IntArray, corrected: int) -> FloatArray:
    """(V,) share of a correction that each view takes: 0 at the views `kept`, 1 at the view `corrected`.

    The harmonic function on the covisibility graph, its edges weighted with the number of shared points. As the
    potential between two nodes of a resistor network, it falls where few points connect the views, so that well
    connected views move together.
    """
    seen = model.point_of >= 0
    shape = len(model), len(model.points)
    incidence = scipy.sparse.csr_matrix((np.ones(seen.sum()), (model.view_of[seen], model.point_of[seen])), shape=shape)
    shared = incidence @ incidence.T
    shared.setdiag(0)
    weight = np.zeros(len(model))
    weight[corrected] = 1.0
    free = np.ones(len(model), bool)
    free[kept] = free[corrected] = False
    # The small term keeps the system regular; a view that shares no point gets weight 0.
    laplacian = scipy.sparse.diags(np.asarray(shared.sum(axis=1)).ravel() + 1e-6) - shared
    weight[free] = scipy.sparse.linalg.spsolve(laplacian[free][:, free].tocsc(), shared[free] @ weight)
    return weight


def distribute_correction(model: SparseModel, weight: FloatArray, scale: float, correction: FloatArray) -> None:
    """Moves each view, and the points that it was the first to see, by its weight (V,) of a similarity.

    correction (4, 4) is rigid, applied after the scale; a weight w of the similarity S is exp(w log S).
    """
    whole = correction.copy()
    whole[:3, :3] *= scale
    generator = np.real(logm(whole))
    seen = np.flatnonzero(model.point_of >= 0)
    points, first = np.unique(model.point_of[seen], return_index=True)
    owner = model.view_of[seen[first]]
    for view in range(len(model)):
        power = np.real(expm(weight[view] * generator))
        own = points[owner == view]
        model.points[own] = model.points[own] @ power[:3, :3].T + power[:3, 3]
        centre = power[:3, :3] @ model.centre(view) + power[:3, 3]
        turned = model.rotation[view] @ power[:3, :3].T / np.cbrt(np.linalg.det(power[:3, :3]))
        model.rotation[view], model.translation[view] = turned, -turned @ centre
