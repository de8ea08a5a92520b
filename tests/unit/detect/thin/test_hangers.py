# SPDX-License-Identifier: Apache-2.0
"""A rod between a ceiling and a tray is no pipe; what ends in the open, in two walls or is longer may be one."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.thin.hangers import is_hanger
from pipeprog_detect.types import Cylinder, PipeEnd
from pipeprog_detect.verification.measured_pipe import MeasuredPipe

WALL, FREE = PipeEnd(0.003, "wall"), PipeEnd(0.003, "free")


def rod(length: float, radius: float, *ends: PipeEnd) -> MeasuredPipe:
    """A rod that hangs from z = 3.2."""
    cylinder = Cylinder(np.array([0.0, 0.0, 3.2]), np.array([0.0, 0.0, 3.2 - length]), radius)
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.002, 0.0, 3.0)
    return MeasuredPipe(Candidate(cylinder, 1e-4, 100, evidence), cylinder, 1e-4, ends=(ends[0], ends[1]))


def tray(height: float) -> np.ndarray:
    """Points (N, 3) of its floor, 3 mm apart."""
    x, y = np.meshgrid(np.arange(-0.1, 0.1, 0.003), np.arange(-0.1, 0.1, 0.003))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


@pytest.mark.parametrize("below", [-0.05, 0.0, 0.05, 0.12])
def test_a_rod_from_the_ceiling_to_a_tray_is_a_hanger(below: float) -> None:
    """At the most, a pipe of DN100 on the tray hides the rod's last part."""
    assert is_hanger(rod(0.6, 0.0086, WALL, FREE), tray(2.6 - below), [])


def test_a_rod_that_comes_from_above_the_images_is_a_hanger() -> None:
    assert is_hanger(rod(0.6, 0.0086, PipeEnd(0.3, "out_of_view"), FREE), tray(2.6), [])


@pytest.mark.parametrize(("before", "hangs"), [(0.002, True), (0.015, True), (0.03, False)])
def test_a_strut_of_which_the_rim_is_seen_before_the_wall_is_a_hanger(before: float, hangs: bool) -> None:
    """`before` [m]: how far before the plane that it meets the rod ends."""
    ceiling = Plane(np.array([0.0, 0.0, 1.0]), 3.2 + before, 4.0)
    along = Plane(np.array([1.0, 0.0, 0.0]), 0.001, 4.0)
    assert is_hanger(rod(0.6, 0.0086, FREE, FREE), tray(2.6), [along, ceiling]) is hangs


@pytest.mark.parametrize(
    ("length", "radius", "ends", "below"),
    [
        (0.6, 0.0086, (WALL, FREE), 0.3),
        (0.6, 0.0086, (FREE, FREE), 0.0),
        (0.6, 0.0086, (WALL, WALL), 0.0),
        (1.2, 0.0086, (WALL, FREE), 0.0),
        (0.6, 0.0365, (WALL, FREE), 0.0),
    ],
)
def test_other_pipes_are_none(length: float, radius: float, ends: tuple[PipeEnd, PipeEnd], below: float) -> None:
    assert not is_hanger(rod(length, radius, *ends), tray(3.2 - length - below), [])


def test_a_wall_beside_a_pipe_is_not_in_its_way() -> None:
    x, z = np.meshgrid(np.arange(-0.3, 0.3, 0.003), np.arange(2.0, 3.2, 0.003))
    wall = np.stack([x.ravel(), np.full(x.size, 0.035), z.ravel()], axis=1)
    assert not is_hanger(rod(0.6, 0.0086, WALL, FREE), wall, [])
