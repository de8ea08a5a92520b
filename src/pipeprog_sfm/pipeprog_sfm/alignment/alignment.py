# SPDX-License-Identifier: Apache-2.0
"""A survey put into the frame of an earlier one: placed by boards or by places, adjusted to it, checked by planes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.alignment.placing import NotAlignedError, Placing, place_by_boards, place_by_places
from pipeprog_sfm.alignment.plane_check import PlaneCheck, agree_across, check_planes
from pipeprog_sfm.alignment.survey_map import SurveyMap
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.model_adjustment import adjust_points, adjust_views
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.guided_matching import link_among

LEAST_SHARED = 0.1  # of its points that both see, where a board places the survey: by chance one in fifty matches
TURNS = 2  # of matching and adjusting: the second finds what the first, a few px off, has not


@dataclass(frozen=True)
class Alignment:
    """How a survey lies in the frame of its reference.

    Attributes:
        by: `boards` or `places`.
        reference_from_model: (4, 4) similarity, after the model's views were adjusted to the reference.
        covariance: (7, 7) of shift [m], turn [rad] and logarithm of the scale.
        shared: points that views of both surveys see.
        planes: what the surfaces say.
    """

    by: str
    reference_from_model: FloatArray
    covariance: FloatArray
    shared: int
    planes: PlaneCheck

    @property
    def scale(self) -> float:
        """Metres of the reference per unit of the model."""
        return float(np.cbrt(np.linalg.det(self.reference_from_model[:3, :3])))

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of `scale`, without that of the reference's metres."""
        return float(np.sqrt(self.covariance[6, 6]))


def align(
    model: SparseModel,
    keyframes: Mapping[int, Keyframe],
    boards: Sequence[PlacedBoard],
    reference: SurveyMap,
    seed: int = 0,
) -> Alignment:
    """Puts a model into the frame of a reference; its views and points are adjusted to what both have seen.

    Args:
        model: of the new survey, adjusted.
        keyframes: those of its views, by stamp.
        boards: as placed in the model.
        reference: map of the earlier survey.
        seed: of random choices.

    Raises:
        NotAlignedError: the reference was not found again, or its surfaces contradict; the model is as it was then.
    """
    placing = place_by_boards(model, boards, reference)
    if placing is None:
        return _placed(model, keyframes, place_by_places(model, keyframes, reference, seed), reference)
    try:
        return _placed(model, keyframes, placing, reference)
    except NotAlignedError as by_boards:
        try:
            return _placed(model, keyframes, place_by_places(model, keyframes, reference, seed), reference)
        except NotAlignedError as by_places:
            raise NotAlignedError(f"{by_boards}; and {by_places}") from None


def _placed(model: SparseModel, keyframes: Mapping[int, Keyframe], placing: Placing, reference: SurveyMap) -> Alignment:
    """Adjusts the model to the reference from this placing on; raises NotAlignedError where it is doubtful."""
    joint, shared = _adjusted(model, keyframes, placing, reference)
    own = np.array([joint.stamps.index(stamp) for stamp in _new_stamps(model, reference)])
    points = joint.points[np.unique(np.concatenate([joint.seen(view) for view in own]))]
    planes = check_planes(points, reference.cloud, reference.normals)
    doubt = planes.contradiction
    # Two boards that hang to each other as they hung are proof enough; a single one hangs on a wall in any room.
    if len(placing.board_normals) == 1 and shared < LEAST_SHARED * len(points) and not doubt:
        (normal,) = placing.board_normals
        if not agree_across(points, reference.cloud, reference.normals, normal):
            doubt = "neither places nor surfaces beside its wall are where the board says: it may hang elsewhere"
    if doubt:
        raise NotAlignedError(f"it would lie in the frame of the reference by {placing.by}, but {doubt}")
    _take_over(model, joint, own, placing.reference_from_model)
    return Alignment(placing.by, placing.reference_from_model, placing.covariance, shared, planes)


def _new_stamps(model: SparseModel, reference: SurveyMap) -> list[int]:
    """Stamps [ns] of the model's views that no keyframe of the reference has: clocks may have been set back."""
    later = int(max(max(model.stamps), reference.stamps.max())) + 1
    return [stamp + later for stamp in model.stamps]


def _adjusted(
    model: SparseModel, keyframes: Mapping[int, Keyframe], placing: Placing, reference: SurveyMap
) -> tuple[SparseModel, int]:
    """The reference with the model's views in it, these adjusted to it, and the number of points that both see."""
    joint = reference.model()
    old, stamps = np.arange(len(joint)), _new_stamps(model, reference)
    known = {keyframe.stamp: keyframe for keyframe in reference.keyframes()}
    known |= {stamp: keyframes[own] for stamp, own in zip(stamps, model.stamps, strict=True)}
    scale = float(np.cbrt(np.linalg.det(placing.reference_from_model[:3, :3])))
    rigid = placing.reference_from_model.copy()
    rigid[:3, :3] /= scale
    joint.absorb(model, scale, rigid)
    joint.stamps[len(old) :] = stamps
    joint.noise = model.noise
    new = np.arange(len(old), len(joint))
    for _ in range(TURNS):
        for view in new.tolist():
            link_among(joint, view, old, known)
        adjust_views(joint, new)
    seen_before = np.unique(joint.point_of[: joint.offsets[len(old)]])
    seen_now = np.unique(joint.point_of[joint.offsets[len(old)] :])
    shared = np.intersect1d(seen_before, seen_now)
    return joint, int((shared >= 0).sum())


def _take_over(model: SparseModel, joint: SparseModel, own: FloatArray, reference_from_model: FloatArray) -> None:
    """Gives the model's views the poses that they have in the reference, in the model's unit; points follow."""
    scale = np.cbrt(np.linalg.det(reference_from_model[:3, :3]))
    turn, shift = reference_from_model[:3, :3] / scale, reference_from_model[:3, 3]
    for view, other in enumerate(own.tolist()):
        model.rotation[view] = joint.rotation[other] @ turn
        model.translation[view] = (joint.translation[other] + joint.rotation[other] @ shift) / scale
    adjust_points(model)
