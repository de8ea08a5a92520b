# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from sitegen.primitives import Kind, Material, Primitive, box, cylinder, disc, elbow, rectangle, unit
from sitegen.raycast import STACK, blocked, build_tree, intersect, nearest

PLAIN = Material("plain", (0.5, 0.5, 0.5))
STEP = 2e-3  # metres between the samples of the brute-force march
SURFACE = 1e-5  # metres: a hit lies on the surface


def depth_inside(p: Primitive, points: np.ndarray) -> np.ndarray:
    """Positive inside the solid, from its definition in local coordinates; (N, 3) -> (N,)."""
    q = (points - p.origin) @ p.rotation.T
    if p.kind == Kind.BOX:
        return (np.array(p.size) - np.abs(q)).min(1)
    if p.kind == Kind.CYLINDER:
        return np.minimum(p.size[0] - np.hypot(q[:, 0], q[:, 1]), np.minimum(q[:, 2], p.size[1] - q[:, 2]))
    ring, tube, half = p.size
    angle = np.clip(np.arctan2(q[:, 0], q[:, 1]), -half, half)
    nearest_on_ring = ring * np.c_[np.sin(angle), np.cos(angle), np.zeros(len(q))]
    return tube - np.linalg.norm(q - nearest_on_ring, axis=1)


def solids(rng: np.random.Generator) -> list[Primitive]:
    a, b = rng.normal(size=3), rng.normal(size=3)
    corner, u, v = rng.normal(size=3) * 0.3, unit(rng.normal(size=3)), unit(rng.normal(size=3))
    if u @ v < -0.8:  # an elbow that turns back on itself is none
        v = -v
    return [
        cylinder(a, b, 0.2, PLAIN),
        box(a - 0.3, a + rng.uniform(0.1, 0.8, 3), PLAIN, yaw=rng.uniform(0, 3)),
        elbow(corner, u, v, 0.15, 0.33, PLAIN),
    ]


@pytest.mark.parametrize("seed", range(6))
def test_first_hit_agrees_with_a_dense_march(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for p in solids(rng):
        origin = 4.0 * unit(rng.normal(size=3))
        middle = (p.bounds[0] + p.bounds[1]) / 2
        for _ in range(40):
            direction = unit(middle + rng.normal(size=3) * 0.3 - origin)
            hit = intersect(int(p.kind), np.array(p.row()), (*origin, *direction), np.inf)
            steps = np.arange(0.0, 9.0, STEP)
            inside = depth_inside(p, origin + steps[:, None] * direction)
            if np.isfinite(hit[0]):
                assert abs(depth_inside(p, (origin + hit[0] * direction)[None])[0]) < SURFACE
                first = steps[np.argmax(inside > 0)] if (inside > 0).any() else hit[0]
                assert hit[0] <= first + SURFACE
                assert not (inside[steps < hit[0] - STEP] > 0).any()
            else:
                assert inside.max() < SURFACE


@pytest.mark.parametrize("seed", range(4))
def test_normals_are_unit_outward_and_across_the_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for p in solids(rng):
        origin = 4.0 * unit(rng.normal(size=3))
        for _ in range(20):
            direction = unit((p.bounds[0] + p.bounds[1]) / 2 + rng.normal(size=3) * 0.1 - origin)
            t, *_, nx, ny, nz, _part = intersect(int(p.kind), np.array(p.row()), (*origin, *direction), np.inf)
            if np.isfinite(t):
                normal = p.rotation.T @ np.array([nx, ny, nz])
                assert np.isclose(np.linalg.norm(normal), 1.0)
                assert normal @ direction < 1e-6
                out, in_ = (origin + t * direction + s * 1e-3 * normal for s in (1, -1))
                assert depth_inside(p, out[None])[0] < 0 < depth_inside(p, in_[None])[0]


def test_flat_shapes_end_at_their_rims() -> None:
    wall = rectangle((0, 0, 0), (0, -1, 0), 2.0, 1.0, PLAIN)
    spot = disc((0, 0, 0), (0, -1, 0), 0.5, PLAIN)
    for p, x, z, expected in [(wall, 0.99, 0.49, 1), (wall, 1.01, 0, 0), (wall, 0, 0.51, 0), (spot, 0.35, 0.35, 1)]:
        t = intersect(int(p.kind), np.array(p.row()), (x, -3.0, z, 0.0, 1.0, 0.0), np.inf)[0]
        assert (t == pytest.approx(3.0)) if expected else np.isinf(t)
    assert np.isinf(intersect(int(spot.kind), np.array(spot.row()), (0.36, -3.0, 0.36, 0.0, 1.0, 0.0), np.inf)[0])


def test_the_hierarchy_finds_what_a_search_through_all_finds() -> None:
    rng = np.random.default_rng(5)
    primitives = [p for _ in range(20) for p in solids(rng)]
    tree = build_tree(primitives)
    stack = np.empty(STACK, np.int64)
    for _ in range(300):
        origin, direction = 4.0 * unit(rng.normal(size=3)), unit(rng.normal(size=3))
        all_hits = [intersect(int(p.kind), np.array(p.row()), (*origin, *direction), np.inf)[0] for p in primitives]
        index, hit = nearest(tree.packed(), stack, (*origin, *direction))
        assert hit[0] == min(all_hits)
        assert index == (int(np.argmin(all_hits)) if np.isfinite(hit[0]) else -1)
        for limit in (2.0, 4.0, 6.0):
            assert blocked(tree.packed(), stack, (*origin, *direction), limit) == (min(all_hits) < limit)


def test_bounds_hold_every_hit() -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        for p in solids(rng):
            origin = 4.0 * unit(rng.normal(size=3))
            for _ in range(20):
                direction = unit((p.bounds[0] + p.bounds[1]) / 2 + rng.normal(size=3) * 0.3 - origin)
                t = intersect(int(p.kind), np.array(p.row()), (*origin, *direction), np.inf)[0]
                if np.isfinite(t):
                    point = origin + t * direction
                    assert (point > p.bounds[0] - SURFACE).all()
                    assert (point < p.bounds[1] + SURFACE).all()
