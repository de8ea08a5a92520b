# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_camera.similarity import similarity
from pipeprog_sfm.boards.rays import cross_matrices, midpoints


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**16), scaled=st.booleans())
def test_similarity_is_found_from_its_points(seed, scaled):
    rng = np.random.default_rng(seed)
    true = np.eye(4)
    true[:3, :3] = (rng.uniform(0.1, 10) if scaled else 1.0) * Rotation.random(random_state=seed).as_matrix()
    true[:3, 3] = rng.normal(0, 5, 3)
    points = np.c_[rng.normal(0, 1, (6, 2)), np.zeros(6)]
    assert similarity(points, points @ true[:3, :3].T + true[:3, 3], scaled=scaled) == pytest.approx(true, abs=1e-8)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**16))
def test_rays_to_a_point_meet_in_it(seed):
    rng = np.random.default_rng(seed)
    origins, points = rng.normal(0, 1, (2, 5, 3)), rng.normal([0, 0, 8], 1, (5, 3))
    rays = points - origins
    distances = np.linalg.norm(rays, axis=-1)
    rays /= distances[..., None]
    found, depths, sines = midpoints(origins[0], rays[0], origins[1], rays[1])
    # Rounding grows with the square of the distance over the base.
    assert found == pytest.approx(points, abs=1e-6)
    assert depths == pytest.approx(distances, abs=1e-6)
    assert sines == pytest.approx(np.linalg.norm(np.cross(*rays), axis=1), abs=1e-6)


def test_a_cross_matrix_multiplies_as_the_cross_product_does():
    a, b = np.random.default_rng(0).normal(0, 1, (2, 4, 3))
    assert np.einsum("nij,nj->ni", cross_matrices(a), b) == pytest.approx(np.cross(a, b), abs=1e-12)
