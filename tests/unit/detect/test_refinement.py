"""The keyframes as judges: which of them are asked, and what runs parallel beside a pipe found by its lines."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_detect.bill import Bill, PipeClass
from pipeprog_detect.config import ContourConfig
from pipeprog_detect.extent import Run
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.refinement import Jury, Measured, aligned, joined
from pipeprog_detect.verify import Candidate, Evidence

# The pipe of `pipe_views`.
PIPE = Cylinder(np.array([0.01, 0.0, -0.2]), np.array([-0.01, 0.01, 0.2]), 0.04)
BILL = Bill((PipeClass("DN65", PIPE.radius, 3.0, (0.0, 0.0, 1.0), 4e-4),))
CAMERA = Camera(480, 270, 345.0, 345.0, 239.5, 134.5)


def looking_along_y(x: float, stamp: int) -> View:
    """A view of nothing from (x, -1.2, 0)."""
    pose = np.eye(4)
    pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, -1.2, 0.0])
    return View(stamp, np.full((CAMERA.height, CAMERA.width), 90, np.uint8), CAMERA, pose)


def level(length: float, slope: float = 0.0, turn: float = 0.0) -> Cylinder:
    """A cylinder along x whose end lies `slope` [rad] towards the cameras and `turn` [rad] higher."""
    axis = np.array([1.0, -np.tan(slope), np.tan(turn)])
    half: FloatArray = 0.5 * length * axis / np.linalg.norm(axis)
    return Cylinder(-half, half, 0.0086)


def test_a_pipe_that_few_keyframes_of_many_show_is_vouched_for(pipe_views: list[View]) -> None:
    """On a long walk every thirtieth part of the keyframes would show the pipe twice, and no outline in three."""
    elsewhere = [looking_along_y(20.0 + number, 1000 + number) for number in range(200)]
    views = [view for number, view in enumerate(pipe_views) for view in [view, *elsewhere[25 * number :][:25]]]
    evidence = Evidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    rough = Cylinder(PIPE.start, PIPE.end, 0.042)
    candidate = Candidate(rough, 0.002, 900, [Run(0.0, rough.length)], evidence)
    assert Jury(views, BILL, ContourConfig()).vouches_for(candidate)
    assert not Jury(elsewhere, BILL, ContourConfig()).vouches_for(candidate)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(0.005, 0.08))
def test_a_slope_that_may_be_wrong_is_that_of_the_pipes_beside(slope: float, known_to: float) -> None:
    """As sure as the proposal's own slope is, and five degrees in any case; its image, from straight ahead, stays."""
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    beside = [level(length) for length in (1.0, 2.0, 3.0)]
    proposed = level(0.7, slope)
    found, sigma = aligned(proposed, beside, views, known_to)
    if abs(np.tan(slope)) < max(np.tan(np.radians(4.9)), 2.9 * known_to):
        assert np.isfinite(sigma)
        assert abs(found.axis @ beside[0].axis) > np.cos(1e-6)
    elif abs(np.tan(slope)) > max(np.tan(np.radians(5.1)), 3.1 * known_to):
        assert not np.isfinite(sigma)
        assert found == proposed


def test_what_runs_in_another_direction_in_the_image_is_not_parallel() -> None:
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    beside = [level(length, turn=np.radians(8.0)) for length in (1.0, 2.0, 3.0)]
    assert not np.isfinite(aligned(level(0.7), beside, views, 0.1)[1])
    assert not np.isfinite(aligned(level(0.7), [*beside[:2], level(1.0)], views, 0.1)[1])


def test_a_piece_found_by_its_lines_is_one_pipe_with_that_of_the_cloud() -> None:
    """As thick as the better measured one; another pipe on its line, too far on, stays one of its own."""

    def piece(low: float, high: float, radius_sigma: float, points: int) -> Measured:
        cylinder = Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.002]), 0.0086 + radius_sigma)
        evidence = Evidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        candidate = Candidate(cylinder, radius_sigma, points, [Run(0.0, cylinder.length)], evidence)
        return Measured(candidate, cylinder, radius_sigma)

    far, short, long = piece(8.0, 9.0, 1e-4, 300), piece(0.0, 0.8, 3e-4, 500), piece(1.0, 3.0, 2e-4, 100)
    found = joined([far, short, long])
    assert len(found) == 2
    assert found[0].cylinder is far.cylinder
    assert found[1].cylinder.length > 2.99
    assert found[1].cylinder.radius == long.cylinder.radius
    assert found[1].radius_sigma == long.radius_sigma
    assert found[1].candidate.points == 600
    assert joined([]) == []
