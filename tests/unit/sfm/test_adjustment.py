"""Bundle adjustment of a synthetic scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeprog_sfm.adjustment import Adjusted, adjust, rotation_from_vector
from pipeprog_sfm.model import SparseModel

VIEWS, POINTS = 6, 150
FOCAL = 900.0


def scene(noise: float, outliers: float = 0.0) -> dict[str, Any]:
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
    return {
        "rotation": rotation,
        "translation": translation,
        "points": points,
        "view": view,
        "rays": rays,
        "start": np.arange(POINTS + 1) * VIEWS,
        "focal": np.full((VIEWS, 2), FOCAL),
    }


def disturbed(truth: dict[str, Any], free: NDArray[np.bool_]) -> Adjusted:
    rng = np.random.default_rng(1)
    turn = np.where(free[:, None], rng.normal(0, 0.005, (VIEWS, 3)), 0)
    shift = np.where(free[:, None], rng.normal(0, 0.01, (VIEWS, 3)), 0)
    start = {
        **truth,
        "rotation": rotation_from_vector(turn) @ truth["rotation"],
        "translation": truth["translation"] + shift,
        "points": truth["points"] + rng.normal(0, 0.02, truth["points"].shape),
    }
    return adjust(**start, free=free, loss_scale=1.0, max_iterations=40, tolerance=1e-10)


def test_exact_observations_give_back_the_scene() -> None:
    truth = scene(noise=0.0)
    free = np.ones(VIEWS, bool)
    free[[0, 5]] = False  # two fixed views fix the scale too
    result = disturbed(truth, free)
    assert result.cost < 1e-8 < result.initial_cost
    assert result.points == pytest.approx(truth["points"], abs=1e-6)
    assert result.translation == pytest.approx(truth["translation"], abs=1e-6)
    assert (result.rotation[~free] == truth["rotation"][~free]).all()


def test_gross_errors_hardly_move_the_result() -> None:
    truth = scene(noise=0.3, outliers=0.1)
    free = np.ones(VIEWS, bool)
    free[[0, 5]] = False
    result = disturbed(truth, free)
    # 150 points of 0.3 px each at 2 m hold a camera to some 0.1 mm; the outliers of 50 px would move it by 10 mm.
    assert np.abs(result.translation - truth["translation"]).max() < 0.002


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotation_from_vector_is_a_rotation_about_it(vector: list[float]) -> None:
    axis = np.array([vector])
    matrix = rotation_from_vector(axis)[0]
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert matrix @ axis[0] == pytest.approx(axis[0], abs=1e-9)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(np.linalg.norm(axis)), abs=1e-9)


def model() -> SparseModel:
    truth = scene(noise=0.0)
    built = SparseModel()
    rays = truth["rays"].reshape(POINTS, VIEWS, 2)
    for view in range(VIEWS):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = truth["rotation"][view], truth["translation"][view]
        built.add_view(view, rays[:, view], truth["focal"][view], pose)
        if view:
            own = np.arange(POINTS) + built.offsets[view]
            built.link(np.repeat(own, view), (own[:, None] - POINTS * np.arange(1, view + 1)).ravel())
    return built


def test_links_become_one_track_a_point() -> None:
    built = model()
    ids, start, _ = built.observations(np.ones(len(built.points), bool))
    assert len(ids) == POINTS
    assert (np.diff(start) == VIEWS).all()
    assert np.sort(built.points[ids], axis=0) == pytest.approx(np.sort(scene(0.0)["points"], axis=0), abs=1e-6)


def test_a_moved_view_contradicts_its_matches() -> None:
    built = model()
    same = np.repeat(np.arange(POINTS, dtype=np.int32)[:, None], 2, axis=1)
    assert built.epipolar_errors(3, 2, same).max() < 1e-6
    built.translation[3] += [0.0, 0.1, 0.0]
    assert np.median(built.epipolar_errors(3, 2, same)) > 10


def test_filter_drops_a_wrong_observation_and_a_point_without_parallax() -> None:
    built = model()
    built.rays[built.offsets[2] + 7] += 10 / FOCAL
    built.filter(*built.observations(np.ones(len(built.points), bool)))
    assert (built.point_of < 0).nonzero()[0].tolist() == [built.offsets[2] + 7]


def test_drop_and_absorb_keep_the_tracks() -> None:
    built, other = model(), model()
    built.drop(2)
    assert built.stamps == [0, 1, 3, 4, 5]
    ids, start, features = built.observations(np.ones(len(built.points), bool))
    assert (np.diff(start) == VIEWS - 1).all()
    assert built.errors(features).max() < 1e-6
    rigid = np.eye(4)
    rigid[:3, :3] = rotation_from_vector(np.array([[0.3, -0.2, 0.5]]))[0]
    rigid[:3, 3] = [1.0, 2.0, 3.0]
    built.absorb(other, 2.0, rigid)
    ids, start, features = built.observations(np.ones(len(built.points), bool))
    assert len(ids) == 2 * POINTS
    assert built.errors(features).max() < 1e-6
