# SPDX-License-Identifier: Apache-2.0
"""Surveys of the synthetic corner on several nights, each with features, noise and a model frame of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scenes import CAMERA, STEP, corner, pose, view

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.alignment.survey_map import SurveyMap, sparse_part
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.mapper import Mapper

SCALE_SIGMA = 0.0003
# The corner's y axis is down, that of a map z up.
MAP_FROM_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


@dataclass(frozen=True)
class Night:
    """A model with its keyframes, and where its views truly were: (4, 4) map_from_camera by stamp."""

    model: SparseModel
    keyframes: dict[int, Keyframe]
    truth: dict[int, FloatArray]

    @property
    def true_similarity(self) -> FloatArray:
        """(4, 4) map_from_model: turned as the views look, since they stand nearly on a line."""
        true = np.array([self.truth[stamp] for stamp in self.model.stamps])
        left, _, right = np.linalg.svd((true[:, :3, :3] @ self.model.rotation).sum(axis=0))
        turn, centres = left @ right, self.model.centres()
        arms, true_arms = (centres - centres.mean(0)) @ turn.T, true[:, :3, 3] - true[:, :3, 3].mean(0)
        scale = (arms * true_arms).sum() / (arms**2).sum()
        found = np.eye(4)
        found[:3, :3] = scale * turn
        found[:3, 3] = true[:, :3, 3].mean(0) - scale * turn @ centres.mean(0)
        return found


def as_it_is(features: Features) -> Features:
    return features


def painted(features: Features) -> Features:
    """As if everything looked different: no descriptor is like the one before."""
    return replace(features, descriptors=np.roll(features.descriptors, 40, axis=1))


def walk(xs: NDArray[Any], night: int, look: Callable[[Features], Features] = as_it_is) -> Night:
    """A walk along the corner on a night, which is the seed of its noise."""
    mapper, truth = Mapper(MapperConfig()), {}
    for n, x in enumerate(xs.tolist()):
        camera_from_world = pose(x, 0.1 * np.sin(4 * x + night))
        stamp = night * 10**15 + n * STEP
        truth[stamp] = MAP_FROM_WORLD @ np.linalg.inv(camera_from_world)
        mapper.add_features(stamp, look(view(camera_from_world, 100 * night + n)), CAMERA)
    mapper.finish()
    return Night(mapper.map.published, mapper.map.keyframes, truth)


@lru_cache
def reference() -> SurveyMap:
    """The map of the first night, with the surfaces of the corner and their normals."""
    night = walk(np.arange(0, 1.8, 0.2), 1)
    found = night.true_similarity
    survey = sparse_part(night.model, night.keyframes, found, float(np.cbrt(np.linalg.det(found[:3, :3]))))
    count = 2 * (len(corner()) // 3)  # wall and floor; the rest is no surface
    turn = MAP_FROM_WORLD[:3, :3]
    normals = np.repeat(np.eye(3)[[2, 1]], count // 2, axis=0) @ turn.T
    cloud = corner()[:count] @ turn.T
    return replace(survey, scale_sigma=SCALE_SIGMA, cloud=cloud.astype(np.float32), normals=normals.astype(np.float32))


def errors(night: Night, reference_from_model: FloatArray) -> tuple[float, float]:
    """Largest errors of the views' places [m] and directions [deg] in the reference."""
    scale = np.cbrt(np.linalg.det(reference_from_model[:3, :3]))
    places, turns = [], []
    for index, stamp in enumerate(night.model.stamps):
        true = night.truth[stamp]
        place = reference_from_model[:3, :3] @ night.model.centre(index) + reference_from_model[:3, 3]
        places.append(np.linalg.norm(place - true[:3, 3]))
        turn = reference_from_model[:3, :3] / scale @ night.model.rotation[index].T @ true[:3, :3].T
        turns.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0))))
    return float(max(places)), float(max(turns))
