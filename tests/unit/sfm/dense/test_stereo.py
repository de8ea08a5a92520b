# SPDX-License-Identifier: Apache-2.0
"""Depth maps against a ray-cast wall with a pipe in front of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.config import StereoConfig
from pipeprog_sfm.dense import plane_sweep
from pipeprog_sfm.dense.stereo import Picture, StereoImage, choose_pairs, depth_map

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
WALL, AXIS, RADIUS = 2.0, 1.75, 0.15  # metres in front of the middle of the row; the pipe stands upright
RANGE = (1.2, 3.0)
CONFIG = StereoConfig()
# Seen from the camera, 60 ms from the first row to the last: 6 px sideways at the wall, and a turn of 4 px.
MOTION = RowMotion(0.06, CAMERA.height, np.array([-0.75, 0.1, 0.1]), np.array([0.1, 0.25, 0.1]))


def texture(points):
    """Grey of surface points: a fixed sum of waves of 3 to 12 cm, about 4 to 16 pixels."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(40, 3))
    waves *= (2 * np.pi / rng.uniform(0.03, 0.12, 40) / np.linalg.norm(waves, axis=1))[:, None]
    return 128.0 + 14.0 * np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 40)).sum(axis=-1)


def pose(centre, rotation=(0.0, 0.0, 0.0)):
    """camera_from_world of a camera at `centre`, turned by a rotation vector; unturned it looks along +z."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(centre, float)
    return matrix


def row_poses(camera_from_world, motion):
    """Rotations (h, 3, 3) and shifts (h, 3) from the world to the camera when it exposes its rows."""
    times = motion.row_times(np.arange(motion.height))[:, None]
    turn = Rotation.from_rotvec(motion.angular * times)
    shift = turn.apply(camera_from_world[:3, 3]) + motion.linear * times
    return turn.as_matrix() @ camera_from_world[:3, :3], shift


def cast(camera_from_world, camera=CAMERA, motion=None, axis=AXIS, radius=RADIUS):
    """Depth along the optical axis and surface points (h, w, 3) of the wall and the pipe."""
    still = RowMotion(0.0, camera.height, np.zeros(3), np.zeros(3))
    rotations, shifts = row_poses(camera_from_world, motion or still)
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], -1)
    rays = np.einsum("vij,vui->vuj", rotations, rays)
    centre = -np.einsum("vij,vi->vj", rotations, shifts)[:, None]
    depth = (WALL - centre[..., 2]) / rays[..., 2]
    a = rays[..., 0] ** 2 + rays[..., 2] ** 2
    b = rays[..., 0] * centre[..., 0] + rays[..., 2] * (centre[..., 2] - axis)
    c = centre[..., 0] ** 2 + (centre[..., 2] - axis) ** 2 - radius**2
    hit = b * b - a * c > 0
    depth[hit] = ((-b - np.sqrt(np.where(hit, b * b - a * c, 0.0))) / a)[hit]
    return depth, centre + depth[..., None] * rays, hit


def view(stamp, camera_from_world, motion=None, axis=AXIS, radius=RADIUS):
    surface = cast(camera_from_world, motion=motion, axis=axis, radius=radius)[1]
    gray = np.clip(texture(surface), 0, 255).astype(np.uint8)
    rolled = None if motion is None else RolledImage(motion, CAMERA)
    return StereoImage(stamp, Picture(np.repeat(gray[..., None], 3, axis=2), CAMERA), camera_from_world, rolled)


LAYOUTS = {
    "along the row": ([0, 0, 0], [[-0.35, 0, 0], [-0.2, 0.02, 0], [0.2, 0, 0.02], [0.35, 0, 0]], 0.0),
    "up and down": ([0, 0, 0], [[0, -0.35, 0], [0.02, -0.2, 0], [0, 0.2, 0], [0, 0.35, 0.03]], 0.0),
    "camera on its side": ([0, 0, 0], [[-0.35, 0, 0], [-0.2, 0, 0], [0.2, 0, 0.02], [0.35, 0, 0]], np.pi / 2),
}


@pytest.fixture(scope="module", params=LAYOUTS, ids=list(LAYOUTS))
def scene(request):
    centre, others, roll = LAYOUTS[request.param]
    reference = view(0, pose(centre, [0, 0, roll]))
    neighbours = [view(i + 1, pose(c, [0.02 * i, -0.1 * c[0], roll])) for i, c in enumerate(others)]
    return reference, neighbours, depth_map(reference, neighbours, RANGE)


def test_depth_lies_on_the_true_surfaces(scene):
    reference, _, found = scene
    depth, _, on_pipe = cast(reference.camera_from_world, found.camera)
    error = found.depth - depth
    interior = np.zeros(depth.shape, bool)
    interior[6:-6, 6:-6] = True
    wall, pipe = interior & ~on_pipe, interior & on_pipe
    # 0.1 px of disparity at a baseline of 0.35 m: 2^2 * 0.1 / (260 * 0.35) = 4 mm
    assert np.isfinite(error[wall]).mean() > 0.85
    assert np.nanmedian(np.abs(error[wall])) < 0.004
    assert np.isfinite(error[pipe]).mean() > 0.85
    assert np.nanmedian(np.abs(error[pipe])) < 0.006
    assert (np.abs(error[interior & np.isfinite(error)]) > 0.05).mean() < 0.05  # outliers, fattened edges


@pytest.mark.parametrize("layout", ["along the row", "up and down"])
def test_a_rolling_shutter_costs_no_depth(layout):
    """The depth map is seen from the pose of the stamp; taken for those of a still camera the images tell less."""
    centre, others, _ = LAYOUTS[layout]
    reference = view(0, pose(centre), MOTION)
    swaying = [replace(MOTION, angular=sign * MOTION.angular) for sign in (-1.0, 1.0, -1.0, 1.0)]
    neighbours = [
        view(i + 1, pose(c, [0.02 * i, -0.1 * c[0], 0.0]), motion)
        for i, (c, motion) in enumerate(zip(others, swaying, strict=True))
    ]
    found = depth_map(reference, neighbours, RANGE)
    depth, _, on_pipe = cast(reference.camera_from_world, found.camera)
    error = (found.depth - depth)[6:-6, 6:-6]
    wall, pipe = ~on_pipe[6:-6, 6:-6], on_pipe[6:-6, 6:-6]
    assert np.isfinite(error[wall]).mean() > 0.85
    assert np.nanmedian(np.abs(error[wall])) < 0.004
    assert np.isfinite(error[pipe]).mean() > 0.85
    assert np.nanmedian(np.abs(error[pipe])) < 0.006
    assert (np.abs(error[np.isfinite(error)]) > 0.05).mean() < 0.05
    still = depth_map(replace(reference, rolled=None), neighbours, RANGE)
    assert np.nanmedian(np.abs(still.depth - depth)[6:-6, 6:-6][wall]) > 0.006


@pytest.mark.parametrize(("axis", "radius"), [(1.93, 0.012), (1.75, 0.02), (1.5, 0.03)])
def test_few_hypotheses_tell_what_all_of_a_wide_range_do(monkeypatch, axis, radius):
    """Pipes of 1.6 to 5 px of the sweep, half of that in the coarse one, before a wall."""
    centre, others, _ = LAYOUTS["along the row"]
    reference = view(0, pose(centre), axis=axis, radius=radius)
    neighbours = [view(i + 1, pose(c), axis=axis, radius=radius) for i, c in enumerate(others)]
    tried, about = [], plane_sweep._about

    def counted(*arguments):
        low, high = about(*arguments)
        tried.append(float(np.mean(high - low + 1)))
        return low, high

    monkeypatch.setattr(plane_sweep, "_about", counted)
    few = depth_map(reference, neighbours, (0.5, 15.0))
    monkeypatch.setattr(plane_sweep, "MARGIN", plane_sweep.MAX_HYPOTHESES)
    every = depth_map(reference, neighbours, (0.5, 15.0))
    assert tried[0] < tried[1] / 3
    depth, _, on_pipe = cast(reference.camera_from_world, few.camera, axis=axis, radius=radius)
    for surface in (on_pipe, ~on_pipe):
        right, possible = ((np.abs(found.depth - depth) < 0.02)[surface].mean() for found in (few, every))
        assert right > 0.97 * possible


def test_same_input_gives_the_same_bytes(scene):
    reference, neighbours, found = scene
    assert depth_map(reference, neighbours, RANGE).depth.tobytes() == found.depth.tobytes()


def test_unit_of_length_does_not_matter(scene):
    reference, neighbours, found = scene

    def scaled(image):
        matrix = image.camera_from_world.copy()
        matrix[:3, 3] *= 8.0  # a power of two: exact
        return StereoImage(image.stamp, image.picture, matrix)

    far = depth_map(scaled(reference), [scaled(n) for n in neighbours], (8 * RANGE[0], 8 * RANGE[1]))
    both = np.isfinite(far.depth) & np.isfinite(found.depth)
    assert both.mean() > 0.99 * np.isfinite(found.depth).mean()
    np.testing.assert_allclose(far.depth[both], 8 * found.depth[both], rtol=2e-3)


def test_wrong_depth_range_is_refused(scene):
    reference, neighbours, _ = scene
    with pytest.raises(ValueError, match="depth range"):
        depth_map(reference, neighbours, (2.0, 1.0))


def test_one_neighbour_is_enough_and_none_gives_nothing(scene):
    reference, neighbours, _ = scene
    single = depth_map(reference, neighbours[:1], RANGE)
    error = single.depth - cast(reference.camera_from_world, single.camera)[0]
    assert np.isfinite(error).mean() > 0.5
    assert np.nanmedian(np.abs(error)) < 0.006
    assert not np.isfinite(depth_map(reference, [], RANGE).depth).any()


def test_bare_surface_has_no_depth():
    noise = np.random.default_rng(0)
    images = [
        StereoImage(
            i, Picture(noise.integers(126, 130, (240, 320, 3)).astype(np.uint8), CAMERA), pose([0.15 * i, 0, 0])
        )
        for i in range(3)
    ]
    assert np.isfinite(depth_map(images[0], images[1:], RANGE).depth).mean() < 0.1  # matches by chance


def test_working_width_bounds_the_map():
    reference, other = view(0, pose([0, 0, 0])), view(1, pose([0.3, 0, 0]))
    reduced = [replace(each, picture=Picture.reduced(each.picture.color, CAMERA, 160)) for each in (reference, other)]
    found = depth_map(reduced[0], reduced[1:], RANGE)
    assert found.depth.shape == found.color.shape[:2] == (60, 80) == (found.camera.height, found.camera.width)
    # halved with aligned pixel areas (2 u + 0.5), then every second centre (2 u)
    np.testing.assert_allclose([2 * 2 * found.camera.cx + 0.5, 4 * found.camera.fx], [CAMERA.cx, CAMERA.fx])


def test_pairs_stand_beside_not_in_front_and_look_the_same_way():
    poses = {
        0: pose([0, 0, 0]),
        1: pose([0.4, 0, 0]),
        2: pose([-0.4, 0, 0]),
        3: pose([0, 0, 0.4]),  # in front: the epipole lies in the image
        4: pose([0.05, 0, 0]),  # too near
        5: pose([1.5, 0, 0]),  # too far
        6: pose([0.4, 0.02, 0], [0, 1.2, 0]),  # looks elsewhere
    }
    chosen = choose_pairs(0, poses, 2.0, StereoConfig(max_pairs=8))
    assert sorted(chosen) == [1, 2]


def test_pairs_of_different_direction_come_first():
    centres = [[0, 0, 0], [0.4, 0, 0], [0.42, 0, 0], [0.38, 0, 0], [-0.4, 0, 0], [0, 0.45, 0]]
    poses = {stamp: pose(centre) for stamp, centre in enumerate(centres)}
    assert sorted(choose_pairs(0, poses, 2.0, StereoConfig(max_pairs=3))) == [1, 4, 5]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 100.0))
def test_pairs_do_not_depend_on_the_frame_or_unit_of_the_world(seed, scale):
    rng = np.random.default_rng(seed)
    poses = {i: pose(rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.3, 0.3, 3)) for i in range(8)}
    moved = pose(rng.uniform(-5, 5, 3), rng.uniform(-2, 2, 3))
    others = {}
    for stamp, matrix in poses.items():
        others[stamp] = matrix @ moved
        others[stamp][:3, 3] *= scale
    assert choose_pairs(0, poses, 2.0, CONFIG) == choose_pairs(0, others, 2.0 * scale, CONFIG)
