# SPDX-License-Identifier: Apache-2.0
"""What a survey keeps for the next one: a thinned sparse model in metres, boards, a thin cloud, the pipes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.model.sparse_model import SparseModel

FEATURES_PER_VIEW = 600  # that are kept of a keyframe: thirty times what a pose needs, 84 kB
LEAST_VIEWS = 3  # of a point that is kept: two rays always meet somewhere, the third confirms the point
CLOUD_CELL = 0.02  # m; walls and floor, which the check asks for, are larger by far


@dataclass(frozen=True)
class MappedBoard:
    """A board where it hung: its name and the (N, 3) centres of its circles in `map` [m]."""

    name: str
    circles: FloatArray


@dataclass(frozen=True)
class MappedPipe:
    """A pipe of the survey: id for its life, class (empty without one), (2, 3) ends and radius [m], sigma of length."""

    life: str
    class_name: str
    ends: FloatArray
    radius: float
    length_sigma: float


def _nothing() -> NDArray[np.float32]:
    return np.empty((0, 3), np.float32)


def _certain() -> FloatArray:
    return np.zeros((7, 7))


@dataclass(frozen=True)
class SurveyMap:
    """The map of a survey, in its frame `map` [m].

    Attributes:
        frame: name of the frame; surveys that were aligned with each other have the same.
        aligned_by: `boards` or `places`; empty where the frame is the survey's own.
        scale_sigma: relative standard deviation of its metres.
        alignment_covariance: (7, 7) of shift [m], turn [rad] and logarithm of the scale; zero in a frame of its own.
        stamps: (V,) int64 of the keyframes [ns].
        cameras: one for each keyframe.
        map_from_camera: (V, 4, 4).
        offsets: (V + 1,) the features of keyframe v are offsets[v]:offsets[v + 1].
        pixels: (K, 2) float32 of the features in the ideal pinhole image, strongest and best spread first.
        descriptors: (K, 128) uint8.
        point_of: (K,) the point that each feature sees.
        points: (P, 3).
        boards: every board at every place where it was seen.
        cloud, normals: (N, 3) float32 of the surfaces, one point in each cell of CLOUD_CELL.
        pipes: what was measured; empty before the detector has been.
    """

    frame: str
    aligned_by: str
    scale_sigma: float
    stamps: IntArray
    cameras: tuple[Camera, ...]
    map_from_camera: FloatArray
    offsets: IntArray
    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    point_of: IntArray
    points: FloatArray
    boards: tuple[MappedBoard, ...] = ()
    cloud: NDArray[np.float32] = field(default_factory=_nothing)
    normals: NDArray[np.float32] = field(default_factory=_nothing)
    pipes: tuple[MappedPipe, ...] = ()
    alignment_covariance: FloatArray = field(default_factory=_certain)

    def keyframes(self) -> list[Keyframe]:
        """The keyframes with the features that were kept."""
        return [
            Keyframe.of(stamp, Features(self.pixels[first:last], self.descriptors[first:last]), camera)
            for stamp, camera, first, last in zip(
                self.stamps.tolist(), self.cameras, self.offsets[:-1], self.offsets[1:], strict=True
            )
        ]

    def model(self) -> SparseModel:
        """The sparse model in metres, its views in the order of the keyframes."""
        model = SparseModel()
        for keyframe, pose in zip(self.keyframes(), np.linalg.inv(self.map_from_camera), strict=True):
            model.add_view(keyframe.stamp, keyframe.rays, keyframe.focal, pose)
        model.points = self.points.copy()
        model.point_of[:] = self.point_of
        return model


def sparse_part(
    model: SparseModel, keyframes: Mapping[int, Keyframe], map_from_model: FloatArray, scale: float
) -> SurveyMap:
    """The map of a model without boards, cloud and pipes, in a frame of its own, by the similarity to `map`.

    scale: metres per unit of the model.
    """
    order = np.argsort(model.stamps, kind="stable")
    views_of_point = np.bincount(model.point_of[model.point_of >= 0], minlength=len(model.points))
    kept: list[IntArray] = []
    for view in order.tolist():
        own = model.point_of[model.features(view)]
        good = np.flatnonzero((own >= 0) & (views_of_point[own] >= LEAST_VIEWS))
        kept.append(good[:FEATURES_PER_VIEW])
    sources = [keyframes[model.stamps[view]] for view in order.tolist()]
    owners = np.concatenate([model.point_of[model.features(v)][rows] for v, rows in zip(order, kept, strict=True)])
    ids, rows_of = np.unique(owners, return_inverse=True)
    points = model.points[ids] @ map_from_model[:3, :3].T + map_from_model[:3, 3]
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    poses[:, :3, :3] = map_from_model[:3, :3] / scale @ model.rotation[order].transpose(0, 2, 1)
    poses[:, :3, 3] = model.centres()[order] @ map_from_model[:3, :3].T + map_from_model[:3, 3]
    pairs = list(zip(sources, kept, strict=True))
    return SurveyMap(
        frame=hashlib.sha256(points.tobytes()).hexdigest()[:16],
        aligned_by="",
        scale_sigma=np.nan,
        stamps=np.array(model.stamps, np.int64)[order],
        cameras=tuple(keyframe.camera for keyframe in sources),
        map_from_camera=poses,
        offsets=np.concatenate([[0], np.cumsum([len(rows) for rows in kept])]),
        pixels=np.concatenate([keyframe.features.keypoints[rows] for keyframe, rows in pairs]),
        descriptors=np.concatenate([keyframe.features.descriptors[rows] for keyframe, rows in pairs]),
        point_of=rows_of.astype(np.int64),
        points=points,
    )


def thinned(points: NDArray[np.float32], normals: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """One point, with its normal, of those in each cell of CLOUD_CELL."""
    cells = np.floor(points / CLOUD_CELL).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    first.sort()
    return points[first], normals[first]
