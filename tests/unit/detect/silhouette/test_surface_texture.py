# SPDX-License-Identifier: Apache-2.0
"""Texture on a pipe's face, or on a wall behind it, in ray-cast views from places in a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.free_space import REFUTED, free_stretches
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.silhouette.surface_texture import face_log_odds
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import barrel_depth, front_points
from tests.unit.detect.straight_ahead import looking_along_y

CONTRAST, LEVEL = 25.0, 128.0  # grey levels: of the texture, and around what
WAVES = 12  # of 6 to 30 mm, all directions: blobs of 2 to 8 px


def texture(points: FloatArray, seed: int) -> FloatArray:
    """Grey level of points (..., 3)."""
    random = np.random.default_rng(seed)
    direction = random.normal(size=(WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    waves = direction * (2.0 * np.pi / random.uniform(0.006, 0.03, WAVES))[:, None]
    phase = random.uniform(0.0, 2.0 * np.pi, WAVES)
    return np.asarray(LEVEL + CONTRAST * np.sqrt(2.0 / WAVES) * np.cos(points @ waves.T + phase).sum(axis=-1))


def views(pipe: Cylinder | None, wall: float, count: int = 5, seed: int = 0, slope: float = 0.0) -> list[View]:
    """A pipe, or none, before a wall at y = `wall` + `slope` x; of the same colour."""
    shown = []
    for stamp, x in enumerate(np.linspace(-0.4, 0.4, count)):
        view = looking_along_y(x, stamp)
        camera, pose = view.camera, view.camera_from_map
        v, u = np.mgrid[: camera.height, : camera.width].astype(float)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        rays = rays @ pose[:3, :3]
        centre = view.centre
        depth = (wall + slope * centre[0] - centre[1]) / (rays[..., 1] - slope * rays[..., 0])
        if pipe is not None:
            depth = np.minimum(depth, barrel_depth(pipe, centre, rays))
        image = texture(centre + depth[..., None] * rays, seed)
        image = cv2.GaussianBlur(image, (0, 0), 0.6) + np.random.default_rng(stamp).normal(0.0, 2.0, image.shape)
        shown.append(replace(view, image=np.clip(np.round(image), 0, 255).astype(np.uint8)))
    return shown


def piece(radius: float, length: float, middle: float = 0.0) -> Cylinder:
    return Cylinder(np.array([middle - 0.5 * length, 0.0, 0.0]), np.array([middle + 0.5 * length, 0.0, 0.0]), radius)


@given(
    radius=st.floats(0.03, 0.11),
    length=st.floats(0.05, 0.3),
    middle=st.floats(-0.2, 0.2),
    behind=st.floats(0.25, 1.0),
    slope=st.floats(-0.5, 0.5),
    seed=st.integers(0, 99),
)
@settings(max_examples=5, deadline=None)
def test_a_face_is_told_from_what_is_behind_a_gap(
    radius: float, length: float, middle: float, behind: float, slope: float, seed: int
) -> None:
    sought = piece(radius, length, middle)
    assert face_log_odds(sought, views(piece(radius, 1.6), behind, seed=seed, slope=slope), []) > REFUTED
    assert face_log_odds(sought, views(None, behind, seed=seed, slope=slope), []) < REFUTED


def test_without_texture_nothing_is_told() -> None:
    plain = [replace(view, image=np.full_like(view.image, 128)) for view in views(piece(0.06, 1.6), 0.3)]
    assert face_log_odds(piece(0.06, 0.2), plain, []) == 0.0
    random = np.random.default_rng(0)
    noise = [replace(view, image=random.integers(120, 136, view.image.shape).astype(np.uint8)) for view in plain]
    assert face_log_odds(piece(0.06, 0.2), noise, []) < REFUTED


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_views_tell_nothing(count: int) -> None:
    assert face_log_odds(piece(0.06, 0.2), views(piece(0.06, 1.6), 0.3)[:count], []) == 0.0


def test_a_face_that_others_hide_is_not_told() -> None:
    column = Cylinder(np.array([0.0, -0.3, -1.0]), np.array([0.0, -0.3, 1.0]), 0.45)
    assert face_log_odds(piece(0.06, 0.2), views(piece(0.06, 1.6), 0.3), []) > REFUTED
    assert face_log_odds(piece(0.06, 0.2), views(piece(0.06, 1.6), 0.3), [column]) == 0.0


@pytest.mark.parametrize("is_there", [True, False])
def test_a_hole_in_the_cloud_is_no_gap_where_the_texture_lies_on_the_face(is_there: bool) -> None:
    """A barrel before a wall of its own colour shows hardly an edge."""
    parts: Sequence[Cylinder] = [piece(0.06, 0.7, -0.4), piece(0.06, 0.7, 0.4)]
    x, z = np.meshgrid(np.arange(-1.5, 1.5, 0.004), np.arange(-0.6, 0.6, 0.004))
    wall = np.stack([x, np.full_like(x, 0.3), z], axis=-1).reshape(-1, 3)
    cloud = np.concatenate([wall, *(front_points(part) for part in parts)])
    shown = with_depths(views(piece(0.06, 1.5) if is_there else None, 0.3), cloud)
    assert bool(free_stretches(piece(0.06, 0.1), shown, [])) is not is_there
