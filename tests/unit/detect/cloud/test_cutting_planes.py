# SPDX-License-Identifier: Apache-2.0
"""The paper's front end: planes that cut pipes, from the user or placed by themselves."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.cutting_planes import (
    CuttingPlane,
    direction_families,
    parse_planes,
    place_planes,
    section_hypotheses,
)
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Cloud, Cylinder

BOQ = BillOfQuantities(
    tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), 0.01 * r) for r in (0.0086, 0.0365, 0.0575))
)
NOISE = 1e-3
LEVEL = CuttingPlane(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]))


def half_pipe(pipe: Cylinder, per_square_metre: int = 80_000, seed: int = 0) -> FloatArray:
    """Points of the side of a pipe that is seen from -y."""
    rng = np.random.default_rng(seed)
    front = np.array([0.0, -1.0, 0.0]) + pipe.axis[1] * pipe.axis
    front /= np.linalg.norm(front)
    side = np.cross(pipe.axis, front)
    count = int(per_square_metre * 2.6 * pipe.radius * pipe.length)
    angle = rng.uniform(-1.3, 1.3, count)[:, None]
    along = rng.uniform(0.0, pipe.length, count)[:, None]
    points = pipe.start + along * pipe.axis + pipe.radius * (np.cos(angle) * front + np.sin(angle) * side)
    return points + rng.normal(0.0, NOISE, points.shape)


def leaning(x: float, radius: float, degrees: float) -> Cylinder:
    """A pipe through (x, 0, 0.5), 0.8 m long, `degrees` off the upright."""
    half = 0.4 * np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    middle = np.array([x, 0.0, 0.5])
    return Cylinder(middle - half, middle + half, radius)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 30.0])
def test_the_axis_leans_as_the_ellipse_tells(degrees: float) -> None:
    pipe = leaning(0.0, 0.0575, degrees)
    tree = octree.build(half_pipe(pipe))
    free = np.ones(len(tree.points), bool)
    found = list(section_hypotheses(tree, free, [LEVEL], NOISE, (0.005, 0.09), 0, straighten=False))
    best = max(found, key=lambda hypothesis: hypothesis.votes).cylinder
    assert best.radius == pytest.approx(pipe.radius, rel=0.1)
    # What the robust fit that follows mends with ease.
    assert abs(best.axis @ pipe.axis) > np.cos(np.radians(12.0))


def angle_error(pipe: Cylinder, straighten: bool) -> float:
    tree = octree.build(half_pipe(pipe, 300_000))
    free = np.ones(len(tree.points), bool)
    found = list(section_hypotheses(tree, free, [LEVEL], NOISE, (0.005, 0.09), 0, straighten))
    errors = [np.degrees(np.arccos(min(abs(float(each.cylinder.axis @ pipe.axis)), 1.0))) for each in found]
    return min(errors, default=90.0)


def test_a_thin_pipe_at_a_slant_needs_its_section_straightened() -> None:
    pipe = leaning(0.0, 0.0086, 30.0)
    assert angle_error(pipe, straighten=True) < 7.0
    assert angle_error(pipe, straighten=True) < 0.7 * angle_error(pipe, straighten=False)


def test_planes_are_placed_across_the_pipes() -> None:
    pipes = [leaning(0.0, 0.0365, 0.0), leaning(0.4, 0.0575, 0.0), leaning(0.9, 0.0365, 90.0)]
    tree = octree.build(np.concatenate([half_pipe(pipe, seed=k) for k, pipe in enumerate(pipes)]))
    planes = place_planes(tree, NOISE, (0.005, 0.09))
    for pipe in pipes:
        cuts = [
            plane
            for plane in planes
            if abs(plane.normal @ pipe.axis) > 0.99
            and ((pipe.start - plane.point) @ plane.normal) * ((pipe.end - plane.point) @ plane.normal) < 0.0
        ]
        assert cuts


def test_two_directions_among_stray_ones_make_two_families_of_planes() -> None:
    pipes = [leaning(0.0, 0.0365, 0.0), leaning(0.9, 0.0365, 90.0)]
    rng = np.random.default_rng(4)
    stray = rng.uniform([-0.5, -0.5, 0.0], [1.4, 0.5, 1.0], (4000, 3))
    points = np.concatenate([*(half_pipe(pipe, seed=k) for k, pipe in enumerate(pipes)), stray])
    normals = []
    for order in (np.arange(len(points)), rng.permutation(len(points))):
        planes = place_planes(octree.build(points[order]), NOISE, (0.005, 0.09))
        normals.append(np.array([plane.normal for plane in planes]))
        for pipe in pipes:
            assert any(abs(plane.normal @ pipe.axis) > 0.999 for plane in planes)
        for plane in planes:
            assert max(abs(plane.normal @ pipe.axis) for pipe in pipes) > 0.999
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", *normals)), 1.0, atol=1e-9)


def test_families_are_the_dense_directions_whatever_their_sign_and_order() -> None:
    rng = np.random.default_rng(5)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    directions = np.concatenate(
        [axis + np.radians(3.0) * rng.normal(size=(n, 3)) for axis, n in zip(axes, (300, 200), strict=True)]
        + [rng.normal(size=(200, 3))]
    )
    directions *= rng.choice([-1.0, 1.0], (len(directions), 1)) / np.linalg.norm(directions, axis=1)[:, None]
    families = direction_families(directions)
    assert len(families) == 2
    for family, axis, count in zip(families, axes, (300, 200), strict=True):
        mean = np.linalg.eigh(directions[family].T @ directions[family])[1][:, 2]
        assert np.degrees(np.arccos(np.abs(mean @ axis))) < 1.0
        assert 0.98 * count < len(family) < 1.1 * count
    order = rng.permutation(len(directions))
    again = direction_families(directions[order])
    assert [set(order[family]) for family in again] == [set(family) for family in families]


@pytest.mark.parametrize("straighten", [False, True])
def test_pipes_are_found_measured_and_only_where_the_user_cuts(straighten: bool) -> None:
    pipes = [leaning(0.0, 0.0365, 5.0), leaning(0.3, 0.0575, 0.0), leaning(0.6, 0.0365, 0.0)]
    points = np.concatenate([half_pipe(pipe, seed=k) for k, pipe in enumerate(pipes)])
    for plane, wanted in (("", 3), ("-1,0,0.5 1,0.1,0.5 0,1,0.5", 3), ("0.45,0,0.5 0.45,1,0.5 0.44,0,0.9", 0)):
        config = DetectConfig(front_end="planes", plane=plane, straighten=straighten)
        found = detect(Cloud(points), BOQ, config)
        assert len(found) == wanted
        for pipe, truth in zip(sorted(found, key=lambda each: each.cylinder.start[0]), pipes, strict=False):
            assert pipe.cylinder.radius == pytest.approx(truth.radius, abs=5e-4)
            assert pipe.cylinder.length == pytest.approx(truth.length, rel=0.03)


def test_three_points_make_a_plane_and_several_are_parted() -> None:
    one, other = parse_planes("0,0,1 1,0,1 0,1,1; 2,0,0 2,1,0 2,0,1")
    np.testing.assert_allclose(np.abs(one.normal), [0, 0, 1])
    np.testing.assert_allclose(np.abs(other.normal), [1, 0, 0])
    assert one.point @ one.normal == pytest.approx(one.normal[2])


@pytest.mark.parametrize("text", ["1,2,3", "a,b,c 1,2,3 4,5,6", "0,0,0 1,1,1 2,2,2", "0,0,0 0,0,1 nan,1,0", "1 2 3"])
def test_what_is_no_plane_is_reported(text: str) -> None:
    with pytest.raises(InputError, match="plane"):
        parse_planes(text)
