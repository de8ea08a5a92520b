# SPDX-License-Identifier: Apache-2.0
"""Pixels at the stamp and of a rolling shutter: each undoes the other, both are those of the rolling generator."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "bags"))

CAMERA = Camera(1280, 720, 914.0, 914.0, 639.5, 359.5)
LENS = replace(CAMERA, distortion=(-0.2, 0.05, 0.001, -0.0005, 0.0))
coordinate = st.floats(-1.5, 1.5)
velocity = st.tuples(coordinate, coordinate, coordinate).map(np.array)
acceleration = velocity.map(lambda each: 4.0 * each)  # 6 m/s^2 and rad/s^2: a fast turn


def seen(seed: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points in front of a camera, and (N, 2) their ideal pixels."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20, 20], [camera.width - 20, camera.height - 20], (50, 2))
    depths = rng.uniform(0.8, 5.0, 50)
    rays = np.c_[(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(50)]
    return depths[:, None] * rays, pixels


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
@settings(max_examples=30, deadline=None)
@given(
    rates=st.tuples(velocity, velocity, acceleration, acceleration),
    readout=st.floats(0.0, 0.035),
    seed=st.integers(0, 100),
)
@example(
    rates=(np.array([0.0, -1.5, 1.0]), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3)), readout=0.03125, seed=0
)
def test_unrolled_undoes_rolled(camera: Camera, rates: tuple[np.ndarray, ...], readout: float, seed: int) -> None:
    points, pixels = seen(seed, camera)
    motion = RowMotion(readout, camera.height, *rates)
    rolled = RolledImage(motion, camera).shown(pixels, points[:, 2])
    np.testing.assert_allclose(motion.unrolled_pixels(rolled, points[:, 2], camera), pixels, atol=0.01)


def test_no_readout_gives_the_input() -> None:
    points, pixels = seen(1, LENS)
    motion = RowMotion(0.0, 720, np.ones(3), np.ones(3))
    assert (motion.unrolled_pixels(pixels, points[:, 2], LENS) == pixels).all()


def test_a_pixel_moves_by_what_the_camera_moves_until_its_row() -> None:
    """At 1 m/s to the right, 2 m away, the last row of 20 ms (10 ms after the stamp) is 10 mm late: 4.57 px."""
    motion = RowMotion(0.02, 720, np.array([-1.0, 0.0, 0.0]), np.zeros(3))
    rolled = RolledImage(motion, CAMERA).shown(np.array([[639.5, 719.5]]), np.array([2.0]))
    assert rolled[0] == pytest.approx([639.5 - 914 * 0.01 / 2, 719.5])


def test_it_is_the_generators_rolling_sensor() -> None:
    """The generator renders row v with the walk's pose at the stamp and the row's time."""
    from sitegen.walk import Walk

    walk = Walk([(0, 0, 1, 0, 0), (2, 0.2, 1, 0.2, 0), (4, 0, 1.2, 0, 0.1)], 0.75, np.random.default_rng(3), False, 1.0)
    stamp, step, readout = 1.7, 1e-4, 0.02
    before, now, after = np.linalg.inv(walk.poses([stamp - step, stamp, stamp + step]))
    rates = []
    for rate in ((after - before) / (2 * step), (after - 2 * now + before) / step**2):
        spin = rate[:3, :3] @ now[:3, :3].T
        across = 0.5 * (spin - spin.T)
        rates += [rate[:3, 3] - spin @ now[:3, 3], np.array([across[2, 1], across[0, 2], across[1, 0]])]
    inside, pixels = seen(4, CAMERA)
    motion = RowMotion(readout, 720, *rates)
    rolled = RolledImage(motion, CAMERA).shown(pixels, inside[:, 2])
    world = (inside - now[:3, 3]) @ now[:3, :3]
    rows = motion.row_times(rolled[:, 1])
    assert rows == pytest.approx(((rolled[:, 1] + 0.5) / 720 - 0.5) * readout)
    poses = np.linalg.inv(walk.poses(stamp + rows))
    shown = np.einsum("nij,nj->ni", poses[:, :3, :3], world) + poses[:, :3, 3]
    expected = shown[:, :2] / shown[:, 2:] * 914 + [639.5, 359.5]
    # What is left is how the acceleration changes within 10 ms: 5 m/s^3 x (10 ms)^3 / 6 / 0.8 m x 914 px = 0.001 px.
    assert np.abs(expected - rolled).max() < 0.003
    assert np.abs(expected - pixels).max() > 1.0


@pytest.mark.parametrize("readout", [-0.01, 1.0, np.nan, np.inf])
def test_a_readout_that_no_camera_has_is_refused(readout: float) -> None:
    with pytest.raises(InputError, match="read-out of"):
        RowMotion(readout, 720, np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("number", range(4))
def test_a_rate_of_nan_is_refused(number: int) -> None:
    rates = np.zeros((4, 3))
    rates[number, 1] = np.nan
    kinds = ["linear velocity", "angular velocity", "linear acceleration", "angular acceleration"]
    with pytest.raises(InputError, match=kinds[number]):
        RowMotion(0.01, 720, *rates)
