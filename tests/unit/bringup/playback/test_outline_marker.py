# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from std_msgs.msg import ColorRGBA

from pipeprog_bringup.playback.outline_marker import outline_marker
from tests.unit.bringup.report.filmed import CAMERA, LEVEL, UPRIGHT, looking_along_y

GREEN, RED = ColorRGBA(g=1.0, a=1.0), ColorRGBA(r=1.0, a=1.0)
PIXEL = 0.5  # px; the lens bends what is straight between two points of an outline


def test_outlines_lie_on_the_limbs_of_the_pipes_in_their_colours() -> None:
    marker = outline_marker(7, "camera", CAMERA, looking_along_y(0.0), [(UPRIGHT, GREEN), (LEVEL, RED)])
    assert (marker.header.stamp.nanosec, marker.header.frame_id) == (7, "camera")
    assert len(marker.points) == 2 * len(marker.outline_colors)
    pixels = np.array([[point.x, point.y] for point in marker.points])
    of_upright = np.repeat([color is GREEN for color in marker.outline_colors], 2)
    ideal = CAMERA.undistort_points(pixels[of_upright])
    middle = CAMERA.fx * np.tan(np.arctan2(0.2, 2.0)) + CAMERA.cx
    half = CAMERA.fx * np.diff(np.tan(np.arctan2(0.2, 2.0) + np.arcsin(0.05 / np.hypot(0.2, 2.0)) * np.array([-1, 1])))
    np.testing.assert_allclose(np.abs(ideal[:, 0] - middle).max(), 0.5 * half[0], atol=PIXEL)
    assert (pixels >= 0).all()
    assert (pixels <= [CAMERA.width - 1, CAMERA.height - 1]).all()


def test_a_camera_that_looks_away_shows_no_outline() -> None:
    behind = looking_along_y(0.0)
    behind[:3, 3] = [0.0, 3.0, 0.0]
    assert not outline_marker(7, "camera", CAMERA, behind, [(UPRIGHT, GREEN)]).points
