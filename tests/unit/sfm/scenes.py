# SPDX-License-Identifier: Apache-2.0
"""Synthetic scenes that the tests of the mapper and its parts share: points with random descriptors, seen on walks."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.sift import Features, root_sift
from pipeprog_sfm.model.bundle_adjustment import Bundle, rotation_from_vector
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.two_view import model_from_pair

VIEWS, POINTS = 6, 150
FOCAL = 900.0
CAMERA = Camera(1280, 720, 900.0, 900.0, 639.5, 359.5)
NOISE = 0.3  # px
STEP = 200_000_000  # ns
BASE = 0.25  # m between two views, keyframes of the walk along the corner


def bundle(noise: float, outliers: float = 0.0) -> Bundle:
    """Views along a line of a cloud of points that all of them see; noise in px, outliers a share of 50 px."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -1, 1.5], [2.5, 1, 3.0], (POINTS, 3))
    rotation = rotation_from_vector(rng.normal(0, 0.05, (VIEWS, 3)))
    centres = np.c_[np.linspace(0, 1, VIEWS), rng.normal(0, 0.05, (VIEWS, 2))]
    translation = -np.einsum("vij,vj->vi", rotation, centres)
    view = np.tile(np.arange(VIEWS), POINTS)
    point = np.repeat(np.arange(POINTS), VIEWS)
    inside = np.einsum("kij,kj->ki", rotation[view], points[point]) + translation[view]
    rays = inside[:, :2] / inside[:, 2:] + rng.normal(0, noise / FOCAL, (len(view), 2))
    wrong = rng.random(len(view)) < outliers
    rays[wrong] += rng.uniform(-50, 50, (wrong.sum(), 2)) / FOCAL
    start = np.arange(POINTS + 1) * VIEWS
    return Bundle(rotation, translation, points, start, view, rays, np.full((VIEWS, 2), FOCAL))


def sparse_model() -> SparseModel:
    """The bundle without noise as a model, its matches linked to tracks."""
    truth = bundle(noise=0.0)
    built = SparseModel()
    rays = truth.rays.reshape(POINTS, VIEWS, 2)
    for view in range(VIEWS):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = truth.rotation[view], truth.translation[view]
        built.add_view(view, rays[:, view], truth.focal[view], pose)
        if view:
            own = np.arange(POINTS) + built.offsets[view]
            built.link(np.repeat(own, view), (own[:, None] - POINTS * np.arange(1, view + 1)).ravel())
    return built


def corner(length: float = 6.0) -> NDArray[np.float64]:
    """Points of a wall (z = 2), a side wall and a floor; x along the walk, y down, metres."""
    rng = np.random.default_rng(7)
    count = int(700 * length)
    wall = np.c_[rng.uniform(-2, length, count), rng.uniform(-1.2, 1.2, count), np.full(count, 2.0)]
    floor = np.c_[rng.uniform(-2, length, count), np.full(count, 1.2), rng.uniform(0.8, 2.0, count)]
    boxes = np.c_[rng.uniform(-2, length, count), rng.uniform(-1, 1, count), rng.uniform(1.6, 2.0, count)]
    return np.concatenate([wall, floor, boxes])


@lru_cache
def world(period: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and their descriptors; with a period the wall's texture repeats along x."""
    rng = np.random.default_rng(3)
    points = corner()
    looks = rng.gamma(0.7, 1.0, (len(points), 128))
    if period is not None:
        third = len(points) // 3
        tile = points[:third][(points[:third, 0] >= 0) & (points[:third, 0] < period)]
        copies = [tile + np.array([n * period, 0, 0]) for n in range(-1, int(6 / period))]
        points = np.concatenate([*copies, points[third:]])
        looks = np.concatenate([*[looks[: len(tile)]] * len(copies), looks[third:]])
    return points, looks


def pose(x: float, yaw: float = 0.0) -> NDArray[np.float64]:
    """camera_from_world of a camera at (x, 0, 0) that looks along z, turned by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    matrix[:3, 3] = -matrix[:3, :3] @ [x, 0.05 * np.sin(3 * x), 0.1 * np.cos(2 * x)]
    return matrix


def view(
    camera_from_world: NDArray[np.float64], seed: int, period: float | None = None, motion: RowMotion | None = None
) -> Features:
    """What a camera sees of the corner; with a motion, through a rolling shutter."""
    rng = np.random.default_rng(seed)
    points, looks = world(period)
    inside = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    pixels = inside[:, :2] / inside[:, 2:] * 900.0 + [639.5, 359.5]
    seen = (inside[:, 2] > 0.2) & (pixels > 0).all(axis=1) & (pixels < [1280, 720]).all(axis=1)
    seen &= rng.random(len(points)) < 0.7
    index = rng.permutation(np.flatnonzero(seen))
    if motion is not None:
        pixels[index] = RolledImage(motion, CAMERA).shown(pixels[index], inside[index, 2])
    clutter = 100
    keypoints = pixels[index] + rng.normal(0, NOISE, (len(index), 2))
    keypoints = np.concatenate([keypoints, rng.uniform([0, 0], [1280, 720], (clutter, 2))])
    descriptors = looks[index] * rng.lognormal(0, 0.15, (len(index), 128))
    descriptors = np.concatenate([descriptors, rng.gamma(0.7, 1.0, (clutter, 128))])
    return Features(keypoints.astype(np.float32), root_sift(descriptors.astype(np.float32)))


def ring_view(angle: float, seed: int) -> Features:
    """What a camera sees that walks round a column at 2 m, looking outwards at a round wall 4 m from the axis."""
    rng = np.random.default_rng(11)
    around = rng.uniform(0, 2 * np.pi, 9000)
    radius, height = rng.uniform(3.4, 4.0, 9000), rng.uniform(-1.2, 1.2, 9000)
    points = np.c_[radius * np.sin(around), height, radius * np.cos(around)]
    looks = rng.gamma(0.7, 1.0, (len(points), 128))
    inside = points @ ring_pose(angle)[:3, :3].T + ring_pose(angle)[:3, 3]
    pixels = inside[:, :2] / inside[:, 2:] * 900.0 + [639.5, 359.5]
    own = np.random.default_rng(seed)
    seen = (inside[:, 2] > 0.2) & (pixels > 0).all(axis=1) & (pixels < [1280, 720]).all(axis=1)
    index = own.permutation(np.flatnonzero(seen & (own.random(len(points)) < 0.7)))
    keypoints = pixels[index] + own.normal(0, NOISE, (len(index), 2))
    descriptors = looks[index] * own.lognormal(0, 0.15, (len(index), 128))
    return Features(keypoints.astype(np.float32), root_sift(descriptors.astype(np.float32)))


def ring_pose(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    matrix[:3, 3] = -matrix[:3, :3] @ [2 * s, 0.05 * np.sin(5 * angle), 2 * c]
    return matrix


def blurred(features: Features, kept: int) -> Features:
    """What is left of features: the first `kept`, the others somewhere else."""
    rng = np.random.default_rng(0)
    keypoints = features.keypoints.copy()
    keypoints[kept:] = rng.uniform([0, 0], [1280, 720], (len(keypoints) - kept, 2))
    return Features(keypoints, features.descriptors)


def centre(camera_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def rates_of(before: NDArray[Any], now: NDArray[Any], after: NDArray[Any], tick: float) -> list[NDArray[np.float64]]:
    """Linear and angular velocity and acceleration (3,) of the world as a camera sees it `now`, by differences.

    Poses (4, 4), or their first three rows, camera_from_world, `tick` [s] apart.
    """
    rates = []
    for rate in ((after - before) / (2 * tick), (after - 2 * now + before) / tick**2):
        spin = rate[:3, :3] @ now[:3, :3].T
        rates += [rate[:3, 3] - spin @ now[:3, 3], 0.5 * np.array([spin[2, 1], spin[0, 2], spin[1, 0]])]
        rates[-1] -= 0.5 * np.array([spin[1, 2], spin[2, 0], spin[0, 1]])  # the antisymmetric part
    return rates


def position_errors(found: dict[int, NDArray[Any]], truth: dict[int, NDArray[Any]]) -> NDArray[np.float64]:
    """Distances from the true positions in metres after the best similarity (Umeyama, PAMI 1991)."""
    a = np.array([centre(found[stamp]) for stamp in found])
    b = np.array([centre(truth[stamp]) for stamp in found])
    da, db = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(db.T @ da)
    sign = np.diag([1, 1, np.linalg.det(u @ vt)])
    rotation, scale = u @ sign @ vt, (s * np.diag(sign)).sum() / (da**2).sum()
    return np.linalg.norm(scale * da @ rotation.T - db, axis=1)


@lru_cache
def keyframe(n: int) -> Keyframe:
    """Number n of a walk along the corner."""
    return Keyframe.of(n * STEP, view(pose(BASE * n), n), CAMERA)


def matched(one: Keyframe, other: Keyframe) -> NDArray[np.int32]:
    """All matches of two keyframes."""
    return match(one.features.descriptors, other.features.descriptors)


def started(first: int, second: int) -> SparseModel:
    """The model of two keyframes of the walk."""
    one, other = keyframe(first), keyframe(second)
    model = model_from_pair(one, other, matched(one, other), seed=0)
    assert model is not None
    return model


def in_model(first: int, second: int, n: int) -> NDArray[np.float64]:
    """True centre of view n in the model that two others have started."""
    origin, unit = pose(BASE * first), np.linalg.norm(centre(pose(BASE * first)) - centre(pose(BASE * second)))
    return (origin[:3, :3] @ centre(pose(BASE * n)) + origin[:3, 3]) / unit
