# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np

from pipeprog_bringup.report.render import ColoredPipe, draw
from pipeprog_detect.types import Cylinder

AHEAD = np.array([0.0, -1.0, 0.2])


def pipe(start, end, label="", radius=0.05):
    return ColoredPipe(Cylinder(np.array(start, float), np.array(end, float), radius), (0.0, 0.0, 1.0), label)


CROSSING = [pipe((-1, 0, 1), (1, 0, 1)), pipe((0, 0, 0), (0, 0, 2))]


def inked(labels):
    """Pixels (H, W) that the labels of two pipes change, which cross in the middle of the picture."""
    pipes = [replace(one, label=label) for one, label in zip(CROSSING, labels, strict=True)]
    cloud = np.random.default_rng(0).uniform((-1, 0.5, 0), (1, 0.5, 2), (2000, 3))
    plain, written = (draw(cloud, None, one, AHEAD, 400) for one in (CROSSING, pipes))
    return (plain.astype(int) != written).any(axis=2)


def test_labels_of_crossing_pipes_do_not_lie_on_each_other():
    first, second, both = inked(("p01", "")), inked(("", "p02")), inked(("p01", "p02"))
    assert both.sum() > 0.95 * (first.sum() + second.sum())


def test_a_pipe_is_painted_in_its_color_where_it_is():
    image = draw(np.empty((0, 3)), None, [pipe((-1, 0, 1), (1, 0, 1), radius=0.1)], AHEAD, 400)
    blue = (image[..., 2] > 90) & (image[..., 0] < 80)
    rows, columns = np.nonzero(blue)
    assert np.ptp(columns) > 0.85 * 400
    assert np.isclose(np.ptp(rows) / np.ptp(columns), 0.1, atol=0.02)  # diameter over length
