# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from targets import CAMERA, camera_from_board

from pipeprog_sfm.boards.conic import (
    circle_centre_images,
    circles_from_conics,
    conic_from_ellipse,
    conic_score,
    project_circles,
)

VIEW = st.tuples(st.floats(-1.5, 1.5), st.floats(-1.0, 1.0), st.floats(0.6, 3.0))
RADIUS = 0.05
CENTRE = np.array([[0.1, -0.05, 0.0]])


def project(pose, points):
    x = (points @ pose[:3, :3].T + pose[:3, 3]) @ CAMERA.matrix.T
    return x[:, :2] / x[:, 2:]


@settings(max_examples=50, deadline=None)
@given(VIEW)
def test_boundary_of_the_circle_lies_on_the_projected_ellipse(place):
    pose = camera_from_board(place, (0, 0, 0))
    conic = conic_from_ellipse(*project_circles(CAMERA.matrix, pose, CENTRE, RADIUS))[0]
    angles = np.linspace(0, 2 * np.pi, 20)
    rim = CENTRE + RADIUS * np.c_[np.cos(angles), np.sin(angles), 0 * angles]
    x = np.c_[project(pose, rim), np.ones(20)]
    gradient = 2 * np.linalg.norm((x @ conic)[:, :2], axis=1)
    assert np.abs(np.einsum("ni,ij,nj->n", x, conic, x) / gradient).max() < 1e-6


@settings(max_examples=50, deadline=None)
@given(VIEW)
def test_pole_of_the_plane_is_the_image_of_the_centre(place):
    pose = camera_from_board(place, (0, 0, 0))
    conics = conic_from_ellipse(*project_circles(CAMERA.matrix, pose, CENTRE, RADIUS))
    assert circle_centre_images(conics, CAMERA.matrix, pose[:3, 2]) == pytest.approx(project(pose, CENTRE), abs=1e-6)


def test_eccentricity_has_the_size_that_theory_gives():
    tilt = np.deg2rad(45)
    pose = camera_from_board((2 * np.sin(tilt), 0, 2 * np.cos(tilt)), (0, 0, 0))
    ellipse = project_circles(CAMERA.matrix, pose, np.zeros((1, 3)), RADIUS)[0]
    shift = np.linalg.norm(ellipse - project(pose, np.zeros((1, 3))))
    assert shift == pytest.approx(CAMERA.fx * (RADIUS / 2) ** 2 * np.sin(tilt) * np.cos(tilt), rel=0.02)


@settings(max_examples=50, deadline=None)
@given(VIEW)
def test_one_of_the_two_circles_of_a_conic_is_the_true_one(place):
    pose = camera_from_board(place, (0, 0, 0))
    conics = conic_from_ellipse(*project_circles(CAMERA.matrix, pose, CENTRE, RADIUS))
    centres, normals = circles_from_conics(conics, CAMERA.matrix, RADIUS)
    true_centre = CENTRE[0] @ pose[:3, :3].T + pose[:3, 3]
    errors = np.linalg.norm(centres[0] - true_centre, axis=1) + 1e-2 * np.linalg.norm(normals[0] - pose[:3, 2], axis=1)
    assert errors.min() < 1e-5


def test_conic_score_tells_the_same_circle_from_another():
    poses = [camera_from_board(place, (0, 0, 0)) for place in ((-0.6, 0.1, 2.0), (0.7, -0.1, 1.8))]
    centres = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0]])
    conics = [conic_from_ellipse(*project_circles(CAMERA.matrix, pose, centres, RADIUS)) for pose in poses]
    one, other = (CAMERA.matrix @ pose[:3] for pose in poses)
    origins = np.stack([centres[0], centres.mean(0)])
    true, wrong = conic_score(conics[0][[0, 0]], conics[1], one, other, origins)
    assert true < 1e-6
    assert wrong > 0.1
