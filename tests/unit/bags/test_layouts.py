# SPDX-License-Identifier: Apache-2.0
from itertools import combinations

import numpy as np
import pytest

from sitegen.field import build_field
from sitegen.lab import build_lab
from sitegen.levels import build_levels
from sitegen.render import Lens, build_scene
from sitegen.site import BOARD_CENTRES, FIELD_RADII, LAB_RADII, Site, segment_gap
from sitegen.visibility import coverage, visible_surface
from sitegen.walk import Walk

PROBE = Lens(320, 180, 228.5, 228.5, 159.5, 89.5)


def lab(seed: int, richness: float = 1.0, period: float = 0.0) -> Site:
    return build_lab(np.random.default_rng(seed), richness, period, 2.0)


def assert_apart(site: Site) -> None:
    for a, b in combinations(site.pipes, 2):
        assert segment_gap(a.start, a.end, b.start, b.end) > a.radius + b.radius
    for pipe in site.pipes:
        assert max(pipe.start[1], pipe.end[1]) < -pipe.radius, "a pipe in the wall"


@pytest.mark.parametrize("seed", range(1, 4))
def test_lab_has_six_pipes_of_five_radii_all_well_seen(seed: int) -> None:
    site = lab(seed)
    assert sorted(p.radius for p in site.pipes) == sorted([*LAB_RADII, 0.0365])
    assert sum("elbow" in p.ends for p in site.pipes) == 1
    assert len(site.boards) == 1
    assert_apart(site)
    scene = build_scene(site.primitives, site.lamps, site.ambient, seed)
    walk = Walk(site.waypoints, 0.75, np.random.default_rng(seed), site.closed_walk, 1.0)
    assert all(c.enough for c in coverage(scene, site.pipes, PROBE, walk.poses(np.arange(40) / 4)))


def test_seeds_differ_and_repeat() -> None:
    assert all(np.array_equal(a.start, b.start) for a, b in zip(lab(3).pipes, lab(3).pipes, strict=True))
    assert not np.array_equal(lab(3).pipes[0].start, lab(4).pipes[0].start)


def test_bare_sites_have_less_texture_and_tiled_ones_a_period_on_the_walls() -> None:
    rich, bare, tiled = lab(1), lab(1, richness=0.2), lab(1, period=1.4)
    assert bare.primitives[0].material.mottle == pytest.approx(0.2 * rich.primitives[0].material.mottle)
    assert [p.material.period for p in tiled.primitives[:4]] == [1.4, 1.4, 1.4, 0.0]


def test_field_has_58_pipes_of_six_radii_in_racks_chains_and_alone() -> None:
    site = build_field(np.random.default_rng(6), 1.0, 0.0, 2.0)
    assert [sum(p.radius == r for p in site.pipes) for r in FIELD_RADII] == [8, 10, 10, 10, 10, 10]
    assert len(site.boards) == 2
    assert sum("elbow" in p.ends for p in site.pipes) >= 2
    assert_apart(site)


def test_levels_have_pipes_in_line_of_sizes_and_axes_that_may_be_nearly_alike() -> None:
    site = build_levels(np.random.default_rng(1), 1.0, 0.0, 2.0)
    assert len(site.boards) == 2
    level = [pipe for pipe in site.pipes if pipe.start[2] == pipe.end[2]]
    in_line = [
        (one, other)
        for one, other in combinations(level, 2)
        if abs(one.start[2] - other.start[2]) < 0.05 and 0.1 < other.start[0] - one.end[0] < 0.5
    ]
    for one, other in combinations(site.pipes, 2):
        beside = segment_gap(one.start, one.end, other.start, other.end) > one.radius + other.radius
        assert beside or any(one is a and other is b for a, b in in_line)
    assert len(in_line) > 20
    assert any(1.0 < max(a.radius, b.radius) / min(a.radius, b.radius) < 1.25 for a, b in in_line)
    assert any(a.radius == b.radius for a, b in in_line)
    assert len(site.pipes) - len(level) > 8, "risers"


def test_boards_face_the_room_with_their_first_circle_up_left() -> None:
    circles = lab(1).boards[0]
    flat = circles[:, [0, 2]] - circles[2, [0, 2]]
    assert np.allclose(flat, BOARD_CENTRES, atol=1e-12)


def test_boards_are_printed_as_badly_as_asked_and_nothing_else_moves() -> None:
    error = 1e-3
    exact = lab(1)
    printed = [build_lab(np.random.default_rng(seed), 1.0, 0.0, 2.0, error) for seed in (1, 1, 2)]
    offsets = [site.boards[0] - lab(seed).boards[0] for site, seed in zip(printed, (1, 1, 2), strict=True)]
    assert np.array_equal(offsets[0], offsets[1])
    assert not np.allclose(offsets[0], offsets[2])
    assert not offsets[0][:, 1].any(), "circles stay on the board's face"
    assert 0.5 * error < np.concatenate(offsets)[:, [0, 2]].std() < 1.5 * error
    assert np.array_equal(printed[0].pipes[-1].start, exact.pipes[-1].start)
    assert printed[0].lamps == exact.lamps


def test_a_boq_plans_a_quarter_more_than_is_there() -> None:
    site = lab(1)
    planned = site.planned_lengths()
    assert list(planned) == [(radius, "") for radius in LAB_RADII]
    assert sum(planned.values()) == pytest.approx(1.25 * sum(p.length for p in site.pipes), abs=0.05 * len(planned))


def test_a_pipe_that_the_camera_misses_is_reported() -> None:
    site = lab(1)
    scene = build_scene(site.primitives, site.lamps, site.ambient, 1)
    away = np.eye(4)
    away[:3, :3] = [[-1, 0, 0], [0, 0, -1], [0, -1, 0]]
    away[:3, 3] = [2.0, -2.0, 1.5]
    assert not any(c.enough for c in coverage(scene, site.pipes, PROBE, np.repeat(away[None], 4, 0)))


def test_surface_points_of_a_pipe_lie_on_it() -> None:
    site = lab(2)
    scene = build_scene(site.primitives, site.lamps, site.ambient, 2)
    walk = Walk(site.waypoints, 0.75, np.random.default_rng(2), site.closed_walk, 0.0)
    points, owners = visible_surface(scene, PROBE, walk.poses([0.0, 2.0, 6.0]))
    for index, pipe in enumerate(site.pipes):
        q = points[owners == index] - pipe.start
        axis = (pipe.end - pipe.start) / pipe.length
        along = q @ axis
        barrel = (along > 1e-4) & (along < pipe.length - 1e-4)
        radius = np.linalg.norm(q - along[:, None] * axis, axis=1)[barrel]
        assert np.abs(radius - pipe.radius).max(initial=0.0) < 1e-5
    assert len(np.unique(owners)) == len(site.pipes) + 1


def test_segment_gap_of_crossing_and_parallel_segments() -> None:
    def gap(*points: list[float]) -> float:
        return segment_gap(*(np.array(p, float) for p in points))

    assert gap([0, 0, 0], [2, 0, 0], [1, -1, 0.5], [1, 1, 0.5]) == pytest.approx(0.5)
    assert gap([0, 0, 0], [2, 0, 0], [3, 1, 0], [5, 1, 0]) == pytest.approx(np.sqrt(2))
    assert gap([0, 0, 0], [2, 0, 0], [0.5, 0.3, 0], [1.5, 0.3, 0]) == pytest.approx(0.3)
