"""A loop closed: where the camera is back, the drift that shows there is spread over the way that it came from."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.linalg import expm, logm

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.sparse.registration import LOCAL_WINDOW, MIN_INLIERS
from pipeprog_sfm.sparse.sparse_model import SparseModel

MAX_DRIFT = 0.05  # of the way since: what exceeds it is no drift but another place that looks alike


def loop_candidates(model: SparseModel, view: int) -> IntArray:
    """Views of long ago, by their numbers; none where the view shares points with them: it is where it seems to be."""
    rank = np.argsort(np.argsort(model.stamps))
    old = np.abs(rank - rank[view]) > 2 * LOCAL_WINDOW
    tied = (model.covisible(view)[old] >= MIN_INLIERS).any()
    return np.flatnonzero(old & (not tied))


def is_drift(model: SparseModel, view: int, other: int, scale: float, correction: FloatArray) -> bool:
    """Whether a correction of a view is as small as drift is on the way between two views.

    correction (4, 4) is rigid, applied after the scale.
    """
    rank, order = np.argsort(np.argsort(model.stamps)), np.argsort(model.stamps)
    between = order[min(rank[view], rank[other]) : max(rank[view], rank[other]) + 1]
    way = np.linalg.norm(np.diff(model.centres()[between], axis=0), axis=1).sum()
    centre = model.centre(view)
    drift = np.linalg.norm(correction[:3, :3] @ centre * scale + correction[:3, 3] - centre)
    return bool(drift <= MAX_DRIFT * way)


def correction_weights(model: SparseModel, kept: IntArray, corrected: int) -> FloatArray:
    """(V,) how much of a correction each view takes: 0 at the views `kept`, 1 at the view `corrected`.

    The harmonic function on the graph of the views, each two tied as firmly as they share points: like the potential
    between two poles of a net of resistors, it falls where the map is thin, and what is tied moves together.
    """
    seen = model.point_of >= 0
    shape = len(model), len(model.points)
    incidence = scipy.sparse.csr_matrix((np.ones(seen.sum()), (model.view_of[seen], model.point_of[seen])), shape=shape)
    ties = incidence @ incidence.T
    ties.setdiag(0)
    share = np.zeros(len(model))
    share[corrected] = 1.0
    free = np.ones(len(model), bool)
    free[kept] = free[corrected] = False
    # A view without ties stays: the small term keeps the system regular.
    laplacian = scipy.sparse.diags(np.asarray(ties.sum(axis=1)).ravel() + 1e-6) - ties
    share[free] = scipy.sparse.linalg.spsolve(laplacian[free][:, free].tocsc(), ties[free] @ share)
    return share


def distribute_correction(model: SparseModel, share: FloatArray, scale: float, correction: FloatArray) -> None:
    """Moves each view and what it was the first to see by its share (V,) of a similarity.

    correction (4, 4) is rigid, applied after the scale; a share of it is a power of the similarity.
    """
    whole = correction.copy()
    whole[:3, :3] *= scale
    generator = np.real(logm(whole))
    seen = np.flatnonzero(model.point_of >= 0)
    points, first = np.unique(model.point_of[seen], return_index=True)
    owner = model.view_of[seen[first]]
    for view in range(len(model)):
        power = np.real(expm(share[view] * generator))
        own = points[owner == view]
        model.points[own] = model.points[own] @ power[:3, :3].T + power[:3, 3]
        centre = power[:3, :3] @ model.centre(view) + power[:3, 3]
        turned = model.rotation[view] @ power[:3, :3].T / np.cbrt(np.linalg.det(power[:3, :3]))
        model.rotation[view], model.translation[view] = turned, -turned @ centre
