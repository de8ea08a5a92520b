# SPDX-License-Identifier: Apache-2.0
"""The similarity between a model and the map of an earlier survey, by places seen again or by boards.

Each keyframe that is located in the reference by itself gives a similarity; that one counts on which most of them
agree, solved anew from the features of all (a generalised absolute pose whose scale is free).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.retrieval import COARSE, Retrieval
from pipeprog_sfm.model.bundle_adjustment import RAYLEIGH_MEDIAN, rotation_from_vector
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.localizer import Localizer
from pipeprog_sfm.sparse.model_merging import similarity_between

NEAR = 8.0  # px by which a feature may miss under the similarity of another keyframe: 2 % of drift over a metre
MAX_LOCATED = 40  # keyframes that are looked for, evenly thinned: the others are found by the poses of these
LEAST_KEYFRAMES = 3  # that must agree: two may show one thing that was carried into another room
LEAST_SPREAD = 1.0  # m, of their centres and of the points that they see, for the same reason
AGREEING = 0.5  # share of the located keyframes that must agree: look-alike places scatter
ROUNDS = 10  # of Gauss-Newton; from a keyframe's own similarity it converges in four to six
MAX_BOARD_ERROR = 0.01  # m, by which circles of boards that hang as they hung may miss: ten times what it is


class NotAlignedError(Exception):
    """A survey was not found again in its reference; the text says why."""


@dataclass(frozen=True)
class Sighting:
    """Features of one keyframe that show points of the reference: (K, 2) rays and (K, 3) points in the reference."""

    view: int
    rays: FloatArray
    points: FloatArray


@dataclass(frozen=True)
class Placing:
    """Where a model lies in a reference.

    Attributes:
        reference_from_model: (4, 4) similarity.
        covariance: (7, 7) of shift [m], turn [rad] about the middle of what was seen, and logarithm of the scale.
        keyframes: number of those that agree.
        by: `boards` or `places`.
        board_normals: (B, 3) of the boards in the reference; empty by places.
    """

    reference_from_model: FloatArray
    covariance: FloatArray
    keyframes: int
    by: str
    board_normals: FloatArray = field(default_factory=lambda: np.empty((0, 3)))


def place_by_boards(model: SparseModel, model_boards: Sequence[PlacedBoard], reference: SurveyMap) -> Placing | None:
    """By the boards of equal names, each where it was seen first; None where there are none, or they were moved.

    Boards may look the same upside down: of the two ways, the one in which cameras were not held on their heads, since
    the z axis of maps is up.
    """
    known = {board.name: board.circles for board in reversed(reference.boards)}
    mine = {place.board.name: place for place in reversed(model_boards)}
    common = [name for name in mine if name in known and len(known[name]) == len(mine[name].circles_in_model)]
    if not common:
        return None
    target = np.concatenate([known[name] for name in common])
    up = -model.rotation[:, 1].mean(0)
    best, least = np.eye(4), np.inf
    for turned in range(2 ** min(len(common), 6)):
        places = [mine[name].upside_down() if turned >> k & 1 else mine[name] for k, name in enumerate(common)]
        found = similarity(np.concatenate([place.circles_in_model for place in places]), target)
        source = np.concatenate([place.circles_in_model for place in places])
        miss = float(np.sqrt(((source @ found[:3, :3].T + found[:3, 3] - target) ** 2).sum(axis=1).mean()))
        if miss < least and (found[:3, :3] @ up)[2] > 0:
            best, least = found, miss
    if least > MAX_BOARD_ERROR:
        return None
    arms = target - target.mean(0)
    size = float(np.sqrt((arms**2).sum()))
    sigmas = [least / np.sqrt(len(target))] * 3 + [least / size] * 4
    # A board's circles lie in a plane: its normal is the direction in which they scatter least.
    board_normals = np.array([np.linalg.svd(known[name] - known[name].mean(0))[2][2] for name in common])
    return Placing(best, np.diag(np.square(np.maximum(sigmas, 1e-6))), 0, "boards", board_normals)


def place_by_places(model: SparseModel, keyframes: Mapping[int, Keyframe], reference: SurveyMap, seed: int) -> Placing:
    """By the keyframes that see places of the reference again; raises NotAlignedError."""
    target = reference.model()
    sightings, hypotheses = _located(model, keyframes, target, {k.stamp: k for k in reference.keyframes()}, seed)
    if len(sightings) < LEAST_KEYFRAMES:
        raise NotAlignedError(
            f"{len(sightings)} of {len(model)} keyframes show places of the reference, {LEAST_KEYFRAMES} are needed"
        )
    # Of the keyframes' own similarities, the one that most features agree on.
    counts = [sum(int((_misses(model, each, one) < NEAR).sum()) for each in sightings) for one in hypotheses]
    placed = hypotheses[int(np.argmax(counts))]
    agreeing: list[Sighting] = []
    for _ in range(3):  # the first similarity is one keyframe's, and off by a per cent where others look
        agreeing = [each for each in sightings if (_misses(model, each, placed) < NEAR).mean() > 0.5]
        if not agreeing:
            break
        placed, covariance = _solved(model, agreeing, placed)
    _require_spread(model, agreeing, len(sightings), placed)
    return Placing(placed, covariance, len(agreeing), "places")


def _located(
    model: SparseModel,
    keyframes: Mapping[int, Keyframe],
    target: SparseModel,
    known: Mapping[int, Keyframe],
    seed: int,
) -> tuple[list[Sighting], list[FloatArray]]:
    """The keyframes that are located in the reference, each by itself, and the similarities of these."""
    localizer = Localizer(known, Retrieval(), seed)
    everywhere = np.arange(len(target))
    sightings, hypotheses = [], []
    for view in range(0, len(model), -(-len(model) // MAX_LOCATED)):
        keyframe = keyframes[model.stamps[view]]
        similar = localizer.similar_views(target, keyframe, everywhere, 1)
        if not len(similar):
            continue
        location = localizer.locate(target, keyframe, localizer.matches(target, keyframe, similar, COARSE))
        found = similarity_between(model, view, target, location)
        if found is None:
            continue
        scale, rigid = found
        hypotheses.append(rigid @ np.diag([scale, scale, scale, 1.0]))
        sightings.append(Sighting(view, keyframe.rays[location.pairs[:, 0]], target.points[location.pairs[:, 1]]))
    return sightings, hypotheses


def _misses(model: SparseModel, sighting: Sighting, reference_from_model: FloatArray) -> FloatArray:
    """(K,) distances in px of features from where the model's pose and a similarity have their points."""
    inside = _inside(model, sighting, np.asarray(np.linalg.inv(reference_from_model), np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        miss = np.linalg.norm((inside[:, :2] / inside[:, 2:] - sighting.rays) * model.focal[sighting.view], axis=1)
    return np.where(inside[:, 2] > 0, miss, np.inf)


def _inside(model: SparseModel, sighting: Sighting, model_from_reference: FloatArray) -> FloatArray:
    points = sighting.points @ model_from_reference[:3, :3].T + model_from_reference[:3, 3]
    return np.asarray(points @ model.rotation[sighting.view].T + model.translation[sighting.view])


def _solved(
    model: SparseModel, sightings: Sequence[Sighting], reference_from_model: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The similarity of the least Cauchy-robust errors in all keyframes, and its (7, 7) covariance.

    The covariance is the sandwich of an M-estimator with the keyframes as clusters (Liang and Zeger 1986): features of
    one keyframe share the error of its pose.
    """
    middle = np.concatenate([each.points for each in sightings]).mean(0)
    loss = RAYLEIGH_MEDIAN * model.noise
    for _ in range(ROUNDS):
        inverse = np.asarray(np.linalg.inv(reference_from_model), np.float64)
        parts = [_linearised(model, each, inverse, middle, loss) for each in sightings]
        matrix, gradients = sum(part[0] for part in parts), np.array([part[1] for part in parts])
        step = np.linalg.solve(matrix, -gradients.sum(0))
        # The step moves the reference's points; the model is moved the other way.
        change = np.eye(4)
        change[:3, :3] = np.exp(step[6]) * rotation_from_vector(step[None, 3:6])[0]
        change[:3, 3] = middle + step[:3] - change[:3, :3] @ middle
        reference_from_model = np.linalg.inv(change) @ reference_from_model
        if np.abs(step).max() < 1e-9:
            break
    spread = np.linalg.inv(matrix)
    return reference_from_model, spread @ (gradients.T @ gradients) @ spread


def _linearised(
    model: SparseModel, sighting: Sighting, model_from_reference: FloatArray, middle: FloatArray, loss: float
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (7, 7) and gradient (7,) of a keyframe by shift, turn and log scale of the reference's points."""
    x, y, z = _inside(model, sighting, model_from_reference).T
    front = z > 1e-9
    x, y, z = x[front], y[front], z[front]
    focal = model.focal[sighting.view]
    residual = (np.stack([x / z, y / z], axis=1) - sighting.rays[front]) * focal
    arms = sighting.points[front] - middle
    by_point = np.zeros((len(z), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = focal[0] / z, -focal[0] * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = focal[1] / z, -focal[1] * y / z**2
    by_shift = by_point @ (model.rotation[sighting.view] @ model_from_reference[:3, :3])
    by_turn = np.cross(arms[:, None], by_shift)
    by_scale = np.einsum("kij,kj->ki", by_shift, arms)[..., None]
    jacobian = np.concatenate([by_shift, by_turn, by_scale], axis=2)
    weight = 1.0 / (1.0 + (residual**2).sum(axis=1) / loss**2)
    weighted = jacobian * weight[:, None, None]
    return np.einsum("kij,kim->jm", weighted, jacobian), np.einsum("kij,ki->j", weighted, residual)


def _require_spread(
    model: SparseModel, agreeing: Sequence[Sighting], located: int, reference_from_model: FloatArray
) -> None:
    """Raises NotAlignedError unless enough keyframes agree, and they see more than one thing from one place."""
    if len(agreeing) < max(LEAST_KEYFRAMES, AGREEING * located):
        raise NotAlignedError(f"of {located} keyframes that show places of the reference, {len(agreeing)} agree")
    scale = np.cbrt(np.linalg.det(reference_from_model[:3, :3]))
    centres = scale * model.centres()[[each.view for each in agreeing]]
    points = np.concatenate([each.points[_misses(model, each, reference_from_model) < NEAR] for each in agreeing])
    if min(_extent(centres), _extent(points)) < LEAST_SPREAD:
        raise NotAlignedError(
            f"what was found again spans {_extent(points):.1f} m, seen over {_extent(centres):.1f} m: "
            f"{LEAST_SPREAD:g} m are needed, since a single thing may have been carried elsewhere"
        )


def _extent(points: FloatArray) -> float:
    """Length of a line on which points spread evenly would have as large a scatter, m."""
    return float(np.sqrt(12 * ((points - points.mean(0)) ** 2).sum(axis=1).mean())) if len(points) else 0.0
