# SPDX-License-Identifier: Apache-2.0
"""Poses from outlines of pipes: one camera of eight stands wrong, and the outlines put it right."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.joint_adjustment import Outline, image_error, moved, pose_motions
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.refinement.contour_adjustment import AdjustedCylinder
from pipeprog_detect.silhouette.apparent_contour import ContourSamples, contour_samples
from pipeprog_detect.silhouette.limb_edges import LimbEdges
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
PIPES = (
    Cylinder(np.array([-0.6, -0.5, 2.0]), np.array([-0.6, 0.5, 2.1]), 0.05),
    Cylinder(np.array([-0.8, 0.3, 2.4]), np.array([0.8, 0.3, 2.4]), 0.04),
    Cylinder(np.array([-0.7, -0.3, 1.8]), np.array([0.7, -0.2, 2.6]), 0.03),
    Cylinder(np.array([0.5, -0.5, 2.8]), np.array([0.6, 0.5, 2.3]), 0.06),
)
WRONG = 3  # the camera that stands wrong
OFF = np.array([1e-3, -2e-3, 1.5e-3, 2e-3, -1e-3, 3e-3])  # rad and m: about a pixel
SIGMA = 0.05  # px that an edge says of itself; where it lies is exact, so that the linearisation alone is left


def views() -> list[View]:
    """Cameras in a row of 0.7 m and at two heights, all looking along +z."""
    result = []
    for number in range(8):
        pose = np.eye(4)
        pose[:3, 3] = -(0.1 * number - 0.35), 0.1 * (number % 2), 0.0
        result.append(View(number, np.zeros((480, 640), np.uint8), CAMERA, pose))
    return result


def offsets(samples: ContourSamples, true: ContourSamples) -> FloatArray:
    """How far (N,) the true contour, a line in each view and side, lies outwards of the samples."""
    result = np.full(len(samples), np.nan)
    for line in np.unique(2 * samples.view + samples.side):
        here, there = (2 * each.view + each.side == line for each in (samples, true))
        normal, point = true.normal[there][0], true.pixel[there][0]
        across = samples.normal[here] @ normal
        result[here] = (point - samples.pixel[here]) @ normal / across
    return result


def test_the_outlines_put_a_camera_right_that_stands_wrong() -> None:
    true = views()
    motion = np.zeros((len(true), 6))
    motion[WRONG] = OFF
    wrong = moved(true, motion)
    seen = []
    for pipe in PIPES:
        scene = Scene.of(pipe, wrong, [])
        samples = contour_samples(pipe, wrong, scene.basis, 12.0)
        off = offsets(samples, contour_samples(pipe, true, scene.basis, 12.0))
        edges = LimbEdges(off[:, None], np.full((len(off), 1), SIGMA), np.ones((len(off), 1)))
        all_of_them = np.ones(len(off), bool)
        found = AdjustedCylinder(scene, np.zeros(5), np.eye(5), all_of_them, all_of_them, 1.0, 1.0, samples, edges)
        seen.append(Outline.of(found))

    poses = np.stack([np.linalg.inv(view.camera_from_map) for view in true])
    before = image_error(np.stack([np.linalg.inv(view.camera_from_map) for view in wrong]), poses, CAMERA.fx)
    right = moved(wrong, pose_motions(seen, wrong, 3.0))
    after = image_error(np.stack([np.linalg.inv(view.camera_from_map) for view in right]), poses, CAMERA.fx)
    assert before > 0.3  # px rms over all cameras
    assert after < 0.1 * before
    stays = moved(wrong, pose_motions(seen, wrong, 1e-6))  # poses that are known do not move
    for view, as_given in zip(stays, wrong, strict=True):
        assert view.camera_from_map == pytest.approx(as_given.camera_from_map, abs=1e-8)


def test_a_view_moves_as_its_camera_frame_does() -> None:
    (view, *_) = moved(views(), np.tile([0.0, 0.0, np.pi / 2, 0.1, 0.0, 0.0], (8, 1)))
    point = view.camera_from_map @ np.linalg.inv(views()[0].camera_from_map) @ [1.0, 0.0, 2.0, 1.0]
    assert point[:3] == pytest.approx([0.1, 1.0, 2.0])
