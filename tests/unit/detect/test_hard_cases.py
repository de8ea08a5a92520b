# SPDX-License-Identifier: Apache-2.0
"""What sites are full of, each scanned with exact truth: pipes that are hard to find, and what only looks like one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import ArrayLike

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.product.product import product_of
from pipeprog_detect.types import Cloud, Cylinder, Pipe
from sitegen.primitives import Primitive, box, cylinder, elbow, rectangle
from sitegen.scan import scan
from sitegen.site import CONCRETE, PIPE_MATERIALS

NOISE = 1e-3
# [m] Three times 0.2 mm, what a cloud's radius and axis are known to beside the noise that its many points average out.
CLOUD_TOLERANCE = 0.6e-3
THIN, MEDIUM, THICK = 0.0086, 0.0365, 0.0575
BOQ = BillOfQuantities(
    tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), 0.01 * r) for r in (THIN, MEDIUM, THICK, 0.0841))
)
STEEL = PIPE_MATERIALS[0]


@dataclass
class Scene:
    """A wall at y = 0 and the floor z = 0, seen from -y, and what stands before them."""

    parts: list[Primitive] = field(
        default_factory=lambda: [
            rectangle([0.75, 0, 0.75], [0, -1, 0], 2.5, 1.5, CONCRETE),
            rectangle([0.75, -1, 0], [0, 0, 1], 2.5, 2.0, CONCRETE),
        ]
    )
    truth: list[Cylinder] = field(default_factory=list)

    def pipe(self, start: ArrayLike, end: ArrayLike, radius: float) -> None:
        self.parts.append(cylinder(start, end, radius, STEEL))
        self.truth.append(Cylinder(np.asarray(start, float), np.asarray(end, float), radius))

    def clamp(self, middle: list[float], axis: list[float], radius: float) -> None:
        half = 0.02 * np.array(axis)
        self.parts.append(cylinder(np.array(middle) - half, np.array(middle) + half, radius + 0.008, CONCRETE))

    def cloud(self, per_station: int = 150_000) -> Cloud:
        rng = np.random.default_rng(5)
        aims = rng.uniform([-0.2, -0.2, -0.4], [1.7, 0.0, 1.3], (per_station, 3))
        stations = [[0.2, -1.9, 1.2], [0.9, -2.0, 0.7], [1.5, -1.8, 1.0]]
        points, normals, _ = scan(self.parts, stations, aims, NOISE, rng)
        return Cloud(points, normals)


def found(cloud: Cloud, with_normals: bool = False, front_end: str = "normals") -> list[Pipe]:
    return detect(cloud if with_normals else Cloud(cloud.points), BOQ, DetectConfig(front_end=front_end))


def off_axis(point: FloatArray, line: Cylinder) -> float:
    offset = point - line.start
    return float(np.linalg.norm(offset - (offset @ line.axis) * line.axis))


def free_end(radius: float) -> float:
    """The surface's occupancy is counted in bins of 5 mm."""
    return 5e-3


def at_elbow(radius: float) -> float:
    """A bend of three radii leaves the line by 5 mm, what a cloud's waviness allows, at this distance."""
    return free_end(radius) + float(np.sqrt(6.0 * radius * 5e-3))


def at_reducer(radius: float) -> float:
    """A slice in which the section's centre is sought: where a cone begins in it, the slice is given up."""
    return 5e-3 + 0.3 * radius


def assert_all_found(scene: Scene, pipes: list[Pipe], tolerance: Callable[[float], float]) -> None:
    """One pipe for each true one, in place, with its radius, class and length to `tolerance` [m]; no other."""
    told = product_of(pipes, BOQ, 0.0)
    left = list(told.pipes)
    for truth in scene.truth:
        middle = truth.middle
        match = [
            pipe
            for pipe in left
            if off_axis(middle, pipe.cylinder) < CLOUD_TOLERANCE
            and abs(pipe.cylinder.axis @ truth.axis) > np.cos(CLOUD_TOLERANCE / (0.5 * truth.length))
            and 0.0 < (middle - pipe.cylinder.start) @ pipe.cylinder.axis < pipe.cylinder.length
        ]
        assert len(match) == 1, truth
        left.remove(match[0])
        assert match[0].cylinder.radius == pytest.approx(truth.radius, abs=CLOUD_TOLERANCE)
        assert match[0].cylinder.length == pytest.approx(truth.length, abs=tolerance(truth.radius))
        assert abs(match[0].cylinder.length - truth.length) < 3.0 * told.length_sigma(match[0])
        assert match[0].class_name == f"{1e3 * truth.radius:g}"
    assert left == []


def upright(scene: Scene, x: float, radius: float, off_wall: float, low: float = 0.2, high: float = 1.1) -> None:
    scene.pipe([x, -off_wall - radius, low], [x, -off_wall - radius, high], radius)


def rack(scene: Scene) -> None:
    for k in range(4):
        upright(scene, 0.4 + 1.3 * 2 * MEDIUM * k, MEDIUM, 0.1, high=1.1 - 0.05 * k)


def thin(scene: Scene) -> None:
    upright(scene, 0.3, THIN, 0.1)
    scene.pipe([0.6, -0.12, 0.9], [1.4, -0.12, 0.9], THIN)


def crossing(scene: Scene) -> None:
    upright(scene, 0.5, MEDIUM, 0.05)
    scene.pipe([0.1, -0.25, 0.7], [1.2, -0.25, 0.7], THICK)


def along_a_wall(scene: Scene) -> None:
    upright(scene, 0.3, MEDIUM, 0.005)
    scene.pipe([0.6, -0.005 - THICK, 0.8], [1.4, -0.005 - THICK, 0.8], THICK)


def behind_clamps(scene: Scene) -> None:
    upright(scene, 0.5, MEDIUM, 0.06)
    upright(scene, 0.9, THICK, 0.06)
    for z in (0.45, 0.85):
        scene.clamp([0.5, -0.06 - MEDIUM, z], [0, 0, 1], MEDIUM)
        scene.clamp([0.9, -0.06 - THICK, z], [0, 0, 1], THICK)


def sloping(scene: Scene) -> None:
    scene.pipe([0.1, -0.2, 0.5], [1.4, -0.2, 0.53], THICK)
    scene.pipe([0.3, -0.15, 0.75], [1.1, -0.15, 1.15], MEDIUM)
    scene.pipe([0.7, -0.45, 0.08], [1.1, -0.3, 0.28], MEDIUM)


def through_an_elbow(scene: Scene) -> None:
    bend = 3.0 * MEDIUM
    scene.pipe([0.4, -0.2, 0.2], [0.4, -0.2, 0.9 - bend], MEDIUM)
    scene.pipe([0.4 + bend, -0.2, 0.9], [1.3, -0.2, 0.9], MEDIUM)
    scene.parts.append(elbow([0.4, -0.2, 0.9], [0, 0, 1], [1, 0, 0], MEDIUM, bend, STEEL))


def through_a_tee(scene: Scene) -> None:
    scene.pipe([0.2, -0.2, 0.8], [1.3, -0.2, 0.8], THICK)
    scene.pipe([0.7, -0.2, 0.8 - THICK], [0.7, -0.2, 0.2], MEDIUM)


def through_a_coupling(scene: Scene) -> None:
    """A sleeve of 6 mm around the pipe is no end of it."""
    scene.pipe([0.1, -0.2, 0.7], [1.4, -0.2, 0.7], MEDIUM)
    scene.parts.append(cylinder([0.7, -0.2, 0.7], [0.78, -0.2, 0.7], MEDIUM + 0.006, STEEL))


def up_to_a_flange(scene: Scene) -> None:
    scene.pipe([0.2, -0.2, 0.7], [1.2, -0.2, 0.7], THICK)
    scene.parts.append(cylinder([1.2, -0.2, 0.7], [1.24, -0.2, 0.7], 1.6 * THICK, STEEL))


def into_walls(scene: Scene) -> None:
    upright(scene, 0.5, MEDIUM, 0.06, low=0.0)
    scene.pipe([0.9, 0.0, 0.8], [0.9, -0.5, 0.8], THICK)


def through_a_reducer(scene: Scene) -> None:
    scene.pipe([0.1, -0.2, 0.7], [0.65, -0.2, 0.7], THICK)
    scene.pipe([0.75, -0.2, 0.7], [1.4, -0.2, 0.7], MEDIUM)
    for k in range(10):  # a cone in steps of two millimetres
        x = 0.65 + 0.01 * k
        scene.parts.append(cylinder([x, -0.2, 0.7], [x + 0.01, -0.2, 0.7], THICK - 0.0021 * (k + 0.5), STEEL))


@pytest.mark.parametrize(
    ("build", "tolerance"),
    [
        *((build, free_end) for build in (rack, thin, crossing, along_a_wall, behind_clamps, sloping, through_a_tee)),
        *((build, free_end) for build in (through_a_coupling, up_to_a_flange, into_walls)),
        (through_an_elbow, at_elbow),
        (through_a_reducer, at_reducer),
    ],
)
def test_pipes_that_are_hard_to_find(build: Callable[[Scene], None], tolerance: Callable[[float], float]) -> None:
    scene = Scene()
    build(scene)
    assert_all_found(scene, found(scene.cloud()), tolerance)


def duct(scene: Scene) -> None:
    scene.parts.append(box([0.1, -0.35, 0.8], [1.5, -0.1, 1.0], CONCRETE))
    scene.parts.append(box([0.3, -0.3, 0.2], [0.38, -0.22, 0.75], CONCRETE))


def column(scene: Scene) -> None:
    scene.parts.append(cylinder([0.7, -0.5, 0.0], [0.7, -0.5, 1.4], 0.3, CONCRETE))


def cable_tray(scene: Scene) -> None:
    scene.parts.append(box([0.1, -0.4, 0.7], [1.5, -0.1, 0.702], CONCRETE))
    scene.parts.append(box([0.1, -0.4, 0.7], [1.5, -0.398, 0.76], CONCRETE))
    scene.parts.append(box([0.1, -0.102, 0.7], [1.5, -0.1, 0.76], CONCRETE))


def doors_and_boxes(scene: Scene) -> None:
    scene.parts.append(box([0.1, -0.05, 0.0], [0.7, -0.01, 1.3], CONCRETE))
    scene.parts.append(box([0.06, -0.08, 0.0], [0.1, 0.0, 1.35], CONCRETE))
    scene.parts.append(box([1.0, -0.4, 0.0], [1.35, -0.1, 0.45], CONCRETE, yaw=0.6))
    scene.parts.append(box([1.0, -0.2, 0.8], [1.3, 0.0, 1.1], CONCRETE))


@pytest.mark.parametrize("build", [duct, column, cable_tray, doors_and_boxes])
@pytest.mark.parametrize("with_normals", [False, True])
def test_what_is_no_pipe(build: Callable[[Scene], None], with_normals: bool) -> None:
    scene = Scene()
    build(scene)
    assert [(pipe.cylinder, pipe.class_name) for pipe in found(scene.cloud(), with_normals)] == []


def fillet(radius: float, with_pipe: bool) -> Cloud:
    """A corner of wall and floor rounded as stereo rounds it, seen from -y, and a pipe over it."""
    rng = np.random.default_rng(2)
    angle = rng.uniform(0.0, 0.5 * np.pi, 40_000)
    x = rng.uniform(0.0, 1.5, 40_000)
    outward = np.stack([np.zeros_like(angle), -np.cos(angle), np.sin(angle)], axis=1)
    centre = np.stack([x, np.full_like(x, -radius), np.full_like(x, radius)], axis=1)
    # The surface lies on the far side of its own axis: its normals point to it.
    scene = Scene()
    if with_pipe:
        scene.pipe([0.2, -0.15, 0.6], [1.3, -0.15, 0.6], MEDIUM)
    points, normals, _ = scan(
        scene.parts,
        [[0.3, -1.9, 1.2], [1.2, -1.8, 1.0]],
        rng.uniform([-0.2, -0.2, -0.6], [1.7, 0.0, 1.0], (150_000, 3)),
        NOISE,
        rng,
    )
    corner = (points[:, 1] > -radius) & (points[:, 2] < radius)
    hollow = centre + radius * np.stack([np.zeros_like(angle), np.cos(angle), -np.sin(angle)], axis=1)
    hollow += rng.normal(0.0, NOISE, hollow.shape)
    return Cloud(np.concatenate([points[~corner], hollow]), np.concatenate([normals[~corner], outward]))


@pytest.mark.parametrize("radius", [0.0176, 0.04])
@pytest.mark.parametrize("with_normals", [False, True])
def test_a_rounded_corner_is_no_pipe_and_hides_none(radius: float, with_normals: bool) -> None:
    (pipe,) = found(fillet(radius, with_pipe=True), with_normals)
    assert pipe.class_name == "36.5"
    assert found(fillet(radius, with_pipe=False), with_normals) == []


SEWERS = BillOfQuantities(
    tuple(PipeClass(str(d), 5e-4 * d, 4.0, (1.0, 0.0, 0.0), 5e-6 * d) for d in (180, 195, 200, 340, 400))
)


CONCAVE = DetectConfig(concave=True)


def sewer(diameter: float, arc_deg: float, seed: int = 0) -> Cloud:
    """A pipe of PVC from inside: a part of its bore, rougher away from the camera, a far end, and stray points."""
    rng = np.random.default_rng(seed)
    bore = 0.5e-3 * diameter * (1.0 - 2.0 / 38.0)
    count = 40_000
    depth = rng.uniform(0.2, 0.9, count)
    angle = np.radians(rng.uniform(-0.5 * arc_deg, 0.5 * arc_deg, count)) - 0.5 * np.pi
    away = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    points = bore * away + np.stack([np.zeros(count), np.zeros(count), -depth], axis=1)
    points += (
        1.5e-3
        * (depth / 0.3)[:, None] ** 2
        * rng.standard_normal(count)[:, None]
        * points
        / np.linalg.norm(points, axis=1, keepdims=True)
    )
    end = rng.uniform([-0.9 * bore, -0.9 * bore, -1.3], [0.9 * bore, 0.9 * bore, -1.2], (8000, 3))
    stray = rng.uniform([-1.0, -0.6, -2.0], [1.0, 0.6, -0.2], (1500, 3))
    normals = np.concatenate([-away, np.tile([0.0, 0.0, 1.0], (8000, 1)), np.tile([0.0, 0.0, 1.0], (1500, 1))])
    return Cloud(np.concatenate([points, end, stray]), normals)


@pytest.mark.parametrize(
    ("diameter", "arc_deg", "with_normals"), [(200, 360, False), (200, 180, True), (400, 240, False), (180, 180, False)]
)
def test_a_sewer_from_inside(diameter: int, arc_deg: float, with_normals: bool) -> None:
    cloud = sewer(diameter, arc_deg)
    cloud = cloud if with_normals else Cloud(cloud.points)
    (pipe,) = detect(cloud, SEWERS, CONCAVE)
    assert pipe.class_name == str(diameter)
    assert pipe.cylinder.radius == pytest.approx(0.5e-3 * diameter * (1 - 2 / 38), abs=1.5e-3)
    assert pipe.cylinder.length > 0.15


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_torn_sewer_from_inside(seed: int) -> None:
    """Half-dark: one wall is seen well, of the rest only shreds of a few centimetres, a fifth of them."""
    cloud = sewer(400, 240, seed).points
    wall, rest = cloud[:40_000], cloud[40_000:]
    angle, depth = np.degrees(np.arctan2(wall[:, 1], wall[:, 0])), -wall[:, 2]
    shred = np.floor((angle + 180) / 10).astype(int) * 100 + np.floor(depth / 0.04).astype(int)
    lit = np.random.default_rng([seed, 1]).random(shred.max() + 1) < 0.2
    (pipe,) = detect(Cloud(np.concatenate([wall[(np.abs(angle + 150) < 25) | lit[shred]], rest])), SEWERS, CONCAVE)
    assert pipe.class_name == "400"
    assert pipe.cylinder.radius == pytest.approx(0.2 * (1 - 2 / 38), abs=2e-3)


def test_from_outside_a_hollow_is_no_pipe_and_from_inside_a_pipe_is_none() -> None:
    assert detect(sewer(200, 240), SEWERS, DetectConfig()) == []
    scene = Scene()
    upright(scene, 0.5, 0.0841, 0.3)
    cloud = scene.cloud()
    planned = BillOfQuantities((PipeClass("168", 0.0841, 4.0, (1.0, 0.0, 0.0), 5e-4),))
    assert len(detect(cloud, planned, DetectConfig())) == 1
    assert detect(cloud, planned, CONCAVE) == []


def test_stray_points_are_no_sewer() -> None:
    stray = np.random.default_rng(1).uniform(-1.0, 1.0, (5000, 3))
    assert detect(Cloud(stray), SEWERS, CONCAVE) == []


def test_the_same_cloud_in_another_order_gives_the_same_pipes() -> None:
    scene = Scene()
    for build in (rack, crossing, sloping):
        build(scene)
    cloud = scene.cloud(80_000)
    shuffled = np.random.default_rng(4).permutation(len(cloud.points))
    for front_end in ("normals", "planes"):
        pipes = found(cloud, front_end=front_end)
        assert len(pipes) > 3
        assert [repr(p) for p in found(Cloud(cloud.points[shuffled]), front_end=front_end)] == [repr(p) for p in pipes]
