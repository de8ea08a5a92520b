# SPDX-License-Identifier: Apache-2.0
"""Where pipes end: at a cap, in the air, at an elbow, a tee, a flange, a wall; and where not: clamp, coupling."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.types import Cylinder, View
from sitegen.primitives import Primitive, bend_tangent, box, cylinder, disc, elbow
from sitegen.site import GALVANISED, PIPE_MATERIALS
from tests.unit.detect.rendered_site import walk_past

RADIUS, BEFORE = 0.03, -0.15
LEFT, RIGHT = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
STEEL, GREEN, BLUE, RED, *_ = PIPE_MATERIALS
TEE_RADIUS = 0.04
# Lying pipes by what is at their ends: height, ends in x [m].
PIPES = {
    "cap, free": (0.33, -0.32, 0.34),
    "elbow, tee": (0.12, -0.36, 0.40),
    "flange, clamp": (-0.09, -0.31, 0.33),
    "wall, coupling": (-0.28, -0.50, 0.30),
}
TEE = Cylinder(np.array([0.44, BEFORE, 0.02]), np.array([0.44, BEFORE, 0.22]), TEE_RADIUS)


def pipe(name: str) -> Cylinder:
    height, start, end = PIPES[name]
    return Cylinder(np.array([start, BEFORE, height]), np.array([end, BEFORE, height]), RADIUS)


def barrel(name: str) -> list[Primitive]:
    each = pipe(name)
    return [cylinder(each.start, each.end, RADIUS, {"cap, free": RED}.get(name, GREEN))]


@pytest.fixture(scope="module")
def views() -> list[View]:
    capped, bent, flanged, coupled = (pipe(name) for name in PIPES)
    things = [thing for name in PIPES for thing in barrel(name)]
    things.append(disc(capped.start + 1e-5 * LEFT, LEFT, RADIUS, RED))
    away = np.array([0.0, 0.0, -1.0])
    tangent = bend_tangent(LEFT, away, 2.2 * RADIUS)
    corner = bent.start + tangent * LEFT
    things.append(elbow(corner, LEFT, away, RADIUS, 2.2 * RADIUS, GREEN))
    things.append(cylinder(TEE.start, TEE.end, TEE_RADIUS, GREEN))
    things.append(cylinder(flanged.start + 0.02 * LEFT, flanged.start, 1.6 * RADIUS, GALVANISED))
    things.append(cylinder(flanged.end - 0.13 * RIGHT, flanged.end - 0.10 * RIGHT, 1.15 * RADIUS, GALVANISED))
    things.append(box((-0.56, -0.6, -0.45), (-0.50, 0.0, -0.17), STEEL))
    things.append(cylinder(-0.03 * RIGHT + coupled.middle, 0.03 * RIGHT + coupled.middle, 1.15 * RADIUS, GALVANISED))
    return walk_past(things)


# Half a pixel at 1.05 m is 1.1 mm. A flange stands out by 0.6 radii: seen 30 deg aslant its edge hides the barrel's end
# by 10 mm. A tee's surface curves away from the barrel by 14 mm. Up to 45 deg of a bend go on along the barrel by its
# radius times the sine. Beside a clamp an end is known to a pixel (two standard deviations); a wall, and a pipe with a
# coupling, to a pixel and a half.
HALF_PIXEL, AT_FLANGE, AT_TEE, AT_ELBOW = 1.2e-3, 10.4e-3, 14e-3, 2.2 * RADIUS * np.sin(np.radians(45.0))
AT_CLAMP, AT_WALL = 2.4e-3, 3.6e-3


@pytest.mark.parametrize(
    ("name", "shorter", "longer"),
    [
        ("cap, free", (HALF_PIXEL, HALF_PIXEL), (HALF_PIXEL, HALF_PIXEL)),
        ("elbow, tee", (HALF_PIXEL, HALF_PIXEL), (AT_ELBOW, AT_TEE)),
        ("flange, clamp", (AT_FLANGE, AT_CLAMP), (AT_FLANGE, AT_CLAMP)),
        ("wall, coupling", (AT_WALL, AT_WALL), (AT_WALL, AT_WALL)),
    ],
)
def test_a_pipe_ends_where_its_barrel_does(
    views: list[View], name: str, shorter: tuple[float, float], longer: tuple[float, float]
) -> None:
    """Found whole from a fifth of it, beside its middle: a clamp 0.1 m before the end and a coupling are no ends."""
    true = pipe(name)
    others = [pipe(other) for other in PIPES if other != name] + [TEE]
    piece = true.cut(0.25 * true.length, 0.45 * true.length)
    found = refine(Start(piece, 0.002), views, others)
    assert found is not None
    start, end = sorted(float(each @ RIGHT) for each in (found.cylinder.start, found.cylinder.end))
    before, beyond = PIPES[name][1] - start, end - PIPES[name][2]
    assert -shorter[0] < before < longer[0]
    assert -shorter[1] < beyond < longer[1]


STUB = Cylinder(np.array([0.0, BEFORE, 0.12]), np.array([0.0, BEFORE, 0.0]), RADIUS)


@pytest.fixture(scope="module")
def stub_views() -> list[View]:
    bend = 2.2 * RADIUS
    corner = STUB.start - bend_tangent(-STUB.axis, LEFT, bend) * STUB.axis
    other = corner + bend * LEFT
    things = [cylinder(STUB.start, STUB.end, RADIUS, GREEN), cylinder(other, other + 0.4 * LEFT, RADIUS, GREEN)]
    return walk_past([*things, elbow(corner, -STUB.axis, LEFT, RADIUS, bend, GREEN)])


@pytest.mark.parametrize("around", [0.06, 0.08, 0.1])
@pytest.mark.parametrize("aside", [-0.02, 0.0, 0.02])
def test_a_stub_ends_before_its_elbow(stub_views: list[View], around: float, aside: float) -> None:
    """Found by a cloud's surface that goes on around the bend and leads the axis aside [m]."""
    start = Cylinder(STUB.start - around * STUB.axis + aside * np.array([0.0, 1.0, 0.0]), STUB.end, RADIUS)
    found = refine(Start(start, 0.002, ends_known=True), stub_views, [])
    assert found is not None
    beyond = max(float(each[2]) for each in (found.cylinder.start, found.cylinder.end)) - float(STUB.start[2])
    assert -HALF_PIXEL < beyond < AT_ELBOW
    assert abs(found.cylinder.radius - RADIUS) < 3.0 * found.radius_sigma < 2e-3
